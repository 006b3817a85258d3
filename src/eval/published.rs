//! What the paper's tables say, method by method, exactly as printed there (spec 9.6).

use serde::Deserialize;
use std::collections::BTreeMap;
use std::sync::OnceLock;

/// Every table of results in the paper.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Published {
    /// RealEstate10K and ACID by number of context views, pictures of 256×256.
    pub novel_views: Vec<PublishedMethod>,
    /// Cost of a reconstruction from 24 context views, on an A100 with 64 GB.
    pub efficiency: Vec<PublishedEfficiency>,
    /// GlobalSplat on RealEstate10K by the number of latents and of Gaussians that each decodes to.
    pub compactness: Vec<PublishedCompactness>,
    /// GlobalSplat on RealEstate10K with one part changed.
    pub ablations: Vec<PublishedAblation>,
}

/// [height, width] of the pictures in [`Published::novel_views`].
pub const IMAGE_SIZE: [u32; 2] = [256, 256];

/// Data sets that are known by a name: in [`PublishedMethod::dataset`] and in files, and as people call them.
pub(super) const DATASETS: [(&str, &str); 3] =
    [("re10k", "RealEstate10K"), ("acid", "ACID"), ("dl3dv", "DL3DV")];

/// The name in files of the data set that is called `name`, either way.
pub(super) fn known_dataset(name: &str) -> Option<&'static str> {
    let is =
        |(file, people): &(&str, &str)| [file, people].iter().any(|known| known.eq_ignore_ascii_case(name));
    DATASETS.iter().find(|names| is(names)).map(|(file, _)| *file)
}

/// One method on one data set.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedMethod {
    /// `re10k` or `acid`.
    pub dataset: String,
    /// As the paper calls it.
    pub method: String,
    /// By the number of context views.
    pub scores: BTreeMap<usize, PublishedScores>,
}

/// What a table has for one method and number of context views; `None` where it has a dash.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct PublishedScores {
    /// In dB.
    pub psnr: Option<f64>,
    /// Structural similarity.
    pub ssim: Option<f64>,
    /// The table's LPIPS.
    pub lpips: Option<f64>,
    /// Thousands of Gaussians; `None` also for methods that make no Gaussians.
    pub kilo_gaussians: Option<f64>,
}

/// One method's cost.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedEfficiency {
    /// As the paper calls it.
    pub method: String,
    /// Largest allocation of the GPU's memory, in GB.
    pub peak_memory_gb: f64,
    /// One forward pass, in milliseconds.
    pub milliseconds: f64,
    /// A scene on disk, in MB; `None` for methods that write none.
    pub disk_mb: Option<f64>,
}

/// One size of the model.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedCompactness {
    /// In all.
    pub gaussians: u32,
    /// Scene tokens.
    pub latents: u32,
    /// Gaussians that a token decodes to.
    pub splats_per_token: u32,
    /// In dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
    /// The table's LPIPS.
    pub lpips: f64,
}

/// One variant of the model.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedAblation {
    /// What is different.
    pub variant: String,
    /// In dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
    /// The table's LPIPS.
    pub lpips: f64,
}

/// The paper's tables.
pub fn published() -> &'static Published {
    static TABLES: OnceLock<Published> = OnceLock::new();
    TABLES
        .get_or_init(|| serde_json::from_str(include_str!("published.json")).expect("the tests read it, too"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    type Row = (String, Vec<Option<f64>>);

    /// The paper's source; where it isn't there, says so.
    fn paper() -> Option<String> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/paper/globalsplat.tex");
        let text = std::fs::read_to_string(&path).ok();
        if text.is_none() {
            println!("skipped: {} is not there", path.display());
        }
        text
    }

    /// Rows of the table that carries `label`, whose first cell is a name.
    fn table(paper: &str, label: &str) -> Vec<Vec<String>> {
        let end = paper.find(&format!(r"\label{{{label}}}")).expect("the label");
        let start = paper[..end].rfind(r"\begin{tabular}").expect("a table before it");
        let rows = paper[start..end].split(r"\\");
        rows.map(|row| row.split('&').map(plain).collect())
            .filter(|row: &Vec<String>| row.len() > 1)
            .collect()
    }

    /// A cell without its typography.
    fn plain(cell: &str) -> String {
        let mut text = cell.trim().rsplit(r"\midrule").next().expect("a part").to_string();
        if let Some(at) = text.find(r"~\cite") {
            let end = at + text[at..].find('}').expect("an end") + 1;
            text.replace_range(at..end, "");
        }
        let typography = [r"\color{gray}", r"\textbf", r"\colorbox", "{top1}", "{top2}", "{top3}", "{", "}"];
        for part in typography {
            text = text.replace(part, "");
        }
        text.replace("Pl\\\"ucker", "Plücker")
            .replace("(non-GS)", "")
            .replace("(Ours)", "")
            .trim()
            .to_string()
    }

    fn number(cell: &str) -> Option<f64> {
        match cell {
            "--" => None,
            other => Some(other.replace(',', "").parse().unwrap_or_else(|_| panic!("a number: {other}"))),
        }
    }

    /// Name and numbers of the rows that have numbers.
    fn rows(table: Vec<Vec<String>>) -> Vec<Row> {
        let filled = table
            .into_iter()
            .filter(|row| row[1] == "--" || row[1].starts_with(|c: char| c.is_ascii_digit()));
        filled.map(|row| (row[0].clone(), row[1..].iter().map(|cell| number(cell)).collect())).collect()
    }

    fn novel_views(dataset: &str) -> Vec<Row> {
        let methods = published().novel_views.iter().filter(|m| m.dataset == dataset);
        let cells = |m: &PublishedMethod| {
            let scores = m.scores.values();
            scores.flat_map(|s| [s.psnr, s.ssim, s.lpips, s.kilo_gaussians]).collect()
        };
        methods.map(|m| (m.method.clone(), cells(m))).collect()
    }

    #[test]
    fn every_row_is_there() {
        let tables = published();
        assert_eq!((novel_views("re10k").len(), novel_views("acid").len()), (12, 6));
        assert_eq!(tables.novel_views.len(), 18);
        for method in &tables.novel_views {
            assert!(method.scores.keys().eq(&[12, 24, 36]), "{}", method.method);
        }
        assert_eq!(tables.efficiency.len(), 6);
        assert_eq!(tables.compactness.len(), 5);
        assert_eq!(tables.ablations.len(), 5);
        let main = tables.novel_views.iter().find(|m| m.dataset == "re10k" && m.method == "GlobalSplat16K");
        let expected = PublishedScores {
            psnr: Some(28.53),
            ssim: Some(0.883),
            lpips: Some(0.14),
            kilo_gaussians: Some(16.),
        };
        assert_eq!(main.expect("a row").scores[&24], expected);
    }

    #[test]
    fn gaussians_of_a_size_are_latents_times_splats() {
        for size in &published().compactness {
            assert_eq!(size.gaussians, size.latents * size.splats_per_token);
        }
    }

    #[test]
    fn novel_views_are_the_papers() {
        let Some(paper) = paper() else { return };
        assert_eq!(novel_views("re10k"), rows(table(&paper, "tab:main_results")));
        assert_eq!(novel_views("acid"), rows(table(&paper, "tab:acid_results")));
    }

    #[test]
    fn efficiency_is_the_papers() {
        let Some(paper) = paper() else { return };
        let table = table(&paper, "tab:efficiency");
        let names = table[0][1..].iter().map(|name| name.replace("Ours", "GlobalSplat"));
        let ours = &published().efficiency;
        assert!(ours.iter().map(|row| row.method.clone()).eq(names));
        let expected = [
            ("Peak Mem (GB)", ours.iter().map(|row| Some(row.peak_memory_gb)).collect()),
            ("Inf. Time (ms)", ours.iter().map(|row| Some(row.milliseconds)).collect()),
            ("Size on Disk (MB)", ours.iter().map(|row| row.disk_mb).collect::<Vec<_>>()),
        ];
        assert_eq!(rows(table), expected.map(|(name, values)| (name.to_string(), values)));
    }

    #[test]
    fn compactness_and_ablations_are_the_papers() {
        let Some(paper) = paper() else { return };
        let compactness = rows(table(&paper, "tab:compactness_tradeoff"));
        let ours = published().compactness.iter().map(|r| {
            let sizes = [f64::from(r.gaussians), f64::from(r.latents), f64::from(r.splats_per_token)];
            sizes.into_iter().chain([r.psnr, r.ssim, r.lpips]).map(Some).collect::<Vec<_>>()
        });
        let theirs = compactness
            .into_iter()
            .map(|(total, rest)| std::iter::once(number(&total)).chain(rest).collect::<Vec<_>>());
        assert!(ours.eq(theirs));

        let theirs = rows(table(&paper, "tab:ablation")).into_iter().map(|(name, values)| {
            (name.replace("Ours (full)", "Full model").replace("w/o", "Without"), values)
        });
        let ours = published().ablations.iter();
        assert!(
            ours.map(|r| (r.variant.clone(), vec![Some(r.psnr), Some(r.ssim), Some(r.lpips)])).eq(theirs)
        );
    }
}
