use super::edits::Edits;
use super::splat_out::{self, LocalOrigin};
use super::{Output, open_capture, warn};
use crate::data::write_transforms_json;
use crate::io::{
    InputFiles, ShLimits, Splat, WriteOptions, check_writable_file, check_writable_splat, fit_splat,
    read_splat, read_splat_without_invalid, splat_files,
};
use crate::metrics::psnr_between;
use crate::render::{SplatEdit, edit_splat, move_cameras, orbit_around_splat};
use crate::scene::{LocalFrame, Upright, splat_frame};
use anyhow::Result;
use clap::Args;
use glam::{DMat4, DVec3};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Change of a coefficient that counts as cut off: more than a quantization step.
const MIN_CUT: f32 = 0.01;

/// Write a splat in another format, edit it, and report the loss.
///
/// Formats are 3DGS' PLY (.ply), PlayCanvas' compressed PLY (.compressed.ply) and SOG (.sog, or meta.json for a folder),
/// Niantic's SPZ (.spz), glTF with KHR_gaussian_splatting (.glb, .gltf) and antimatter15's .splat, which has no spherical
/// harmonics; mkkellogg's .ksplat is only read. The written file is read again and rendered beside the original: the loss is the
/// PSNR between both, over eight views around the splat or over the capture's cameras.
///
/// SPZ stores coefficients within ±1, a SOG a few sets of coefficients for all Gaussians, and a .splat only one coefficient per
/// color channel; viewers for browsers keep no more of a PLY's coefficients, either (--clamp-sh). With a capture, the
/// coefficients are fitted to look the same from its cameras; otherwise values out of range are clamped, which may cost much
/// quality.
///
/// Edits are applied one after the other, and the capture's cameras move along. The loss then includes what the edits change;
/// a second figure is that of the format alone.
///
/// Gaussians that can't be rendered are removed and counted: those with values that aren't finite, which other commands refuse,
/// and those whose rotation has length 0.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat convert room.ply room.spz\n  \
    globalsplat convert room.ply small.spz --sh-degree 1 --scene captures/room\n  \
    globalsplat convert room.ply shared.ply --clamp-sh --scene captures/room\n  \
    globalsplat convert room.ply upright.ply --upright --scene captures/room --length 0,0,0 0,0,1.2 2.05\n  \
    globalsplat convert room.ply table.sog --up z --crop-sphere 0,0,0,2 --filter-floaters --scale 10")]
pub struct Convert {
    /// Input splat: .ply, .compressed.ply, .sog, meta.json, .spz, .splat, .glb, .gltf, .ksplat or .zip
    #[arg(value_name = "FROM")]
    from: PathBuf,
    /// Output file, whose extension selects the format
    #[arg(value_name = "TO")]
    to: PathBuf,
    /// Remove spherical harmonics of higher degrees, or add some that are 0
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(0..=3))]
    sh_degree: Option<i64>,
    /// Keep within what viewers for browsers show, whatever the format holds: a Gaussian's own color in [0, 1], other
    /// coefficients within ±1
    #[arg(long)]
    clamp_sh: bool,
    /// Minimize the loss for the cameras of this capture, and report the loss over them
    #[arg(long, value_name = "PATH")]
    scene: Option<PathBuf>,
    /// Also write the cameras of --scene, moved along with the splat, as a nerfstudio transforms.json of undistorted cameras, for
    /// example for `render --path`
    #[arg(long, value_name = "FILE", requires = "scene")]
    cameras_out: Option<PathBuf>,
    #[command(flatten)]
    local_origin: LocalOrigin,
    /// Version of SPZ, 2 to 4; by default 4, or with --clamp-sh 3, because some viewers don't read 4
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=4))]
    spz_version: Option<u32>,
    #[command(flatten)]
    edits: Edits,
}

impl Convert {
    pub fn run(self) -> Result<Output> {
        check_writable_splat(&self.to)?;
        self.local_origin.check(&self.to, Some(&self.from))?;
        let capture = self.scene.as_deref().map(open_capture).transpose()?;
        let mut inputs = InputFiles::default();
        capture.iter().for_each(|capture| capture.add_input_files(&mut inputs));
        let cameras = capture.as_ref().map(|capture| capture.cameras());
        let (options, edits): (Vec<_>, Vec<_>) =
            self.edits.read(cameras, &mut inputs, warn)?.into_iter().unzip();
        splat_files(&self.to).iter().try_for_each(|file| inputs.check_file(file))?;
        if let Some(file) = &self.cameras_out {
            [&self.from, &self.to].into_iter().for_each(|path| inputs.add_all(splat_files(path)));
            inputs.check_file(file)?;
            check_writable_file(file)?;
        }
        let source = read_splat_without_invalid(&self.from)?;
        warn(&source.warnings);
        // The input is described before the output replaces it, in case they are the same file.
        let mut from = description(&self.from, &source)?;
        from["warnings"] = source.warnings.clone().into();
        let cameras = capture.as_ref().map_or(vec![], |capture| capture.cameras());
        for (option, edit) in options.iter().zip(&edits) {
            if matches!(edit, SplatEdit::Merge(other) if other.antialiased != source.antialiased) {
                let kind = if source.antialiased { "are" } else { "aren't" };
                eprintln!(
                    "{option}: only one of the splats is antialiased; all Gaussians {kind} rendered so, as those of {}",
                    self.from.display()
                );
            }
        }
        let is_far =
            |edit: &SplatEdit| matches!(edit, SplatEdit::Merge(other) if other.origin != DVec3::ZERO);
        let has_origin = source.origin != DVec3::ZERO || edits.iter().any(is_far);
        let edited = edit_splat(&source, &edits, &cameras)?;
        let moved = match edited.from_original == DMat4::IDENTITY {
            true => source,
            false => edit_splat(&source, &[SplatEdit::Transform(edited.from_original)], &[])?.splat,
        };
        let cameras = move_cameras(&cameras, &edited.from_original);
        let original = edited.splat;
        let degree = self.sh_degree.map_or(original.sh_degree, |degree| degree as usize);
        let limits = match self.clamp_sh {
            true => ShLimits::of_viewers(degree),
            false => ShLimits::up_to(degree),
        };
        let fitted = fit_splat(&self.to, &original, &limits, &cameras)?;
        // Without a capture the writer clamps by itself.
        let is_fitted = capture.is_some() || self.clamp_sh;
        let written = if is_fitted { &fitted } else { &original }.with_sh_degree(degree);
        // Edits give an origin to a splat that has none.
        let kept = if has_origin { original.origin } else { DVec3::ZERO };
        let origin = self.local_origin.choose(kept, || match &capture {
            Some(_) => LocalFrame::from_cameras(&cameras).origin,
            None if has_origin => kept,
            None => splat_frame(&original).origin,
        });
        let begin = Instant::now();
        let spz_version = self.spz_version.unwrap_or(if self.clamp_sh { 3 } else { 4 });
        splat_out::write(&self.to, &written, origin, &WriteOptions { spz_version })?;
        let written_at = Instant::now();
        let copy = read_splat(&self.to)?;
        let mut to = description(&self.to, &copy)?;
        to["read_seconds"] = written_at.elapsed().as_secs_f64().into();
        to["write_seconds"] = written_at.duration_since(begin).as_secs_f64().into();

        if let (Some(file), Some(capture)) = (&self.cameras_out, &capture) {
            write_transforms_json(file, &capture.render_names(), &cameras)?;
        }
        let cameras = if capture.is_some() { cameras } else { orbit_around_splat(&moved) };
        if capture.is_none() {
            self.warn_clamped(&original, &fitted);
        }
        let psnr = psnr_between(&moved, &copy, &cameras)?;
        // What the file's format costs, without what the edits change.
        let file_psnr =
            (!edits.is_empty()).then(|| psnr_between(&original, &copy, &cameras)).transpose()?.flatten();
        let views = cameras.len();
        let edits: Vec<_> = options.iter().zip(&edited.counts).collect();
        let loss = match psnr {
            Some(psnr) => format!("{psnr:.2} dB between renders of both"),
            None => "the same pixels".into(),
        };
        let of_file = file_psnr.map(|psnr| format!("; {psnr:.2} dB between the edited splat and the file"));
        let lines = std::iter::once(line(&from))
            .chain(edits.iter().map(|(option, count)| format!("{option}: {count} Gaussians")))
            .chain(edited.upright.iter().map(Upright::to_string))
            .chain([line(&to), format!("{views} views: {loss}{}", of_file.unwrap_or_default())]);
        let text = lines.collect::<Vec<_>>().join("\n");
        let edits: Vec<_> =
            edits.iter().map(|(edit, count)| json!({ "edit": edit, "gaussians": count })).collect();
        let json = json!({
            "from": from, "transform": { "matrix": edited.from_original.transpose().to_cols_array_2d() }, "edits": edits, "to": to, "views": views, "psnr": psnr, "file_psnr": file_psnr,
            "same_pixels": psnr.is_none(),
        });
        Ok(Output::new(json, text))
    }

    /// Warns if coefficients are out of the representable range and no capture was given to fit the others to.
    fn warn_clamped(&self, original: &Splat, held: &Splat) {
        let coefficients =
            |index: usize| original.sh_of(index).as_flattened().iter().zip(held.sh_of(index).as_flattened());
        let is_cut = |(original, held): &(&f32, &f32)| (*original - *held).abs() > MIN_CUT;
        let cut = (0..held.len()).flat_map(coefficients).filter(is_cut).count();
        let share = 100. * cut as f64 / (3 * held.sh.len()) as f64;
        if cut > 0 {
            let share = if share < 0.05 { "less than 0.1".into() } else { format!("{share:.1}") };
            let who = if self.clamp_sh { "viewers hold" } else { "the format holds" };
            eprintln!(
                "{}: {share} % of the colors' coefficients are beyond what {who} and cut off; --scene, with the cameras that \
                 matter, loses less",
                self.to.display()
            );
        }
    }
}

fn description(path: &Path, splat: &Splat) -> Result<Value> {
    Ok(json!({
        "splat": path.to_string_lossy(),
        "gaussians": splat.len(),
        "sh_degree": splat.sh_degree,
        "bytes": splat_out::total_bytes(path)?,
    }))
}

fn line(report: &Value) -> String {
    let name = report["splat"].as_str().unwrap_or_default();
    format!(
        "{name}: {} Gaussians, SH degree {}, {} bytes",
        report["gaussians"], report["sh_degree"], report["bytes"]
    )
}
