//! The paper's tables in `eval::published`, compared with the paper's source.

use crate::common::skip;
use globalsplat::eval::{PublishedMethod, PublishedScores, published};
use std::path::Path;

type Row = (String, Vec<Option<f64>>);

/// Returns the paper's source, or skips the test if it isn't available.
fn paper() -> Option<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/paper/globalsplat.tex");
    let text = std::fs::read_to_string(&path).ok();
    if text.is_none() {
        skip("the paper", &format!("{} is missing", path.display()));
    }
    text
}

/// Returns the rows of the table with `label`, each with a name in its first cell.
fn table(paper: &str, label: &str) -> Vec<Vec<String>> {
    let end = paper.find(&format!(r"\label{{{label}}}")).expect("the label");
    let start = paper[..end].rfind(r"\begin{tabular}").expect("a table before it");
    let rows = paper[start..end].split(r"\\");
    rows.map(|row| row.split('&').map(plain).collect()).filter(|row: &Vec<String>| row.len() > 1).collect()
}

/// Returns a cell's text without typography.
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
    text.replace("Pl\\\"ucker", "Plücker").replace("(non-GS)", "").replace("(Ours)", "").trim().to_string()
}

fn number(cell: &str) -> Option<f64> {
    match cell {
        "--" => None,
        other => Some(other.replace(',', "").parse().unwrap_or_else(|_| panic!("a number: {other}"))),
    }
}

/// Returns name and values of the rows that have values.
fn rows(table: Vec<Vec<String>>) -> Vec<Row> {
    let filled =
        table.into_iter().filter(|row| row[1] == "--" || row[1].starts_with(|c: char| c.is_ascii_digit()));
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
fn the_main_result_is_there() {
    let main = published().novel_views.iter().find(|m| m.dataset == "re10k" && m.method == "GlobalSplat16K");
    let expected = PublishedScores {
        psnr: Some(28.53),
        ssim: Some(0.883),
        lpips: Some(0.14),
        kilo_gaussians: Some(16.),
    };
    assert_eq!(main.expect("a row").scores[&24], expected);
}

#[test]
fn all_tables_are_the_papers() {
    let Some(paper) = paper() else { return };
    assert_eq!(novel_views("re10k"), rows(table(&paper, "tab:main_results")));
    assert_eq!(novel_views("acid"), rows(table(&paper, "tab:acid_results")));

    let efficiency = table(&paper, "tab:efficiency");
    let names = efficiency[0][1..].iter().map(|name| name.replace("Ours", "GlobalSplat"));
    let ours = &published().efficiency;
    assert!(ours.iter().map(|row| row.method.clone()).eq(names));
    let expected = [
        ("Peak Mem (GB)", ours.iter().map(|row| Some(row.peak_memory_gb)).collect()),
        ("Inf. Time (ms)", ours.iter().map(|row| Some(row.milliseconds)).collect()),
        ("Size on Disk (MB)", ours.iter().map(|row| row.disk_mb).collect::<Vec<_>>()),
    ];
    assert_eq!(rows(efficiency), expected.map(|(name, values)| (name.to_string(), values)));

    let compactness = rows(table(&paper, "tab:compactness_tradeoff"));
    let ours = published().compactness.iter().map(|r| {
        let sizes = [f64::from(r.gaussians), f64::from(r.latents), f64::from(r.splats_per_token)];
        sizes.into_iter().chain([r.psnr, r.ssim, r.lpips]).map(Some).collect::<Vec<_>>()
    });
    let theirs = compactness
        .into_iter()
        .map(|(total, rest)| std::iter::once(number(&total)).chain(rest).collect::<Vec<_>>());
    assert!(ours.eq(theirs));

    let theirs = rows(table(&paper, "tab:ablation"))
        .into_iter()
        .map(|(name, values)| (name.replace("Ours (full)", "Full model").replace("w/o", "Without"), values));
    let ours = published().ablations.iter();
    assert!(ours.map(|r| (r.variant.clone(), vec![Some(r.psnr), Some(r.ssim), Some(r.lpips)])).eq(theirs));
}
