use super::{open_capture, print_json, splat_out, warn};
use anyhow::Result;
use clap::Args;
use glam::DVec3;
use globalsplat::eval::psnr_between;
use globalsplat::io::{
    InputFiles, ShLimits, Splat, check_writable_splat, fit_splat, read_splat, read_splat_without_invalid,
};
use globalsplat::render::orbit_around_gaussians;
use globalsplat::scene::{Camera, Gaussians, ImageSize, LocalFrame, splat_frame};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Number and size of views on an orbit around a splat, if no capture is given.
const VIEWS: usize = 8;
const SIZE: ImageSize = ImageSize { width: 512, height: 512 };

/// Write a splat in another format, or with spherical harmonics of another degree, and report the loss.
///
/// Formats are 3DGS' PLY (.ply), PlayCanvas' compressed PLY (.compressed.ply), Niantic's SPZ (.spz) and antimatter15's .splat,
/// which has no spherical harmonics. The written file is read again and rendered beside the original: the loss is the PSNR
/// between both, over eight views around the splat or over the capture's cameras.
///
/// SPZ stores coefficients within ±1, and a .splat stores only one coefficient per colour channel; viewers for browsers keep no
/// more of a PLY's coefficients, either (--for-viewers). With a capture, the remaining coefficients are fitted to look the same
/// from its cameras; otherwise values out of range are clamped, which may cost much quality.
///
/// Gaussians that can't be rendered are removed and counted: those with values that aren't finite, which other commands refuse,
/// and those whose rotation has length 0.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat convert room.ply room.spz\n  \
    globalsplat convert room.ply small.spz --sh-degree 1 --scene captures/room\n  \
    globalsplat convert room.ply shared.ply --for-viewers --scene captures/room")]
pub struct Convert {
    /// Input splat: .ply, .compressed.ply, .spz or .splat
    #[arg(value_name = "FROM")]
    from: PathBuf,
    /// Output file, whose extension selects the format
    #[arg(value_name = "TO")]
    to: PathBuf,
    /// Remove spherical harmonics of higher degrees, or add some that are 0
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(0..=3))]
    sh_degree: Option<i64>,
    /// Keep within what viewers for browsers show, whatever the format holds: a Gaussian's own colour in [0, 1], other
    /// coefficients within ±1
    #[arg(long)]
    for_viewers: bool,
    /// Minimize the loss for the cameras of this capture, and report the loss over them
    #[arg(long, value_name = "PATH")]
    scene: Option<PathBuf>,
    /// Write coordinates relative to the centre of the scene, which is stored in a file beside the splat: far from the world's
    /// origin, as in UTM coordinates, float32 and the formats' own number types lose detail
    #[arg(long)]
    local_origin: bool,
    /// Print the result as one JSON object
    #[arg(long)]
    json: bool,
}

impl Convert {
    pub fn run(self) -> Result<()> {
        check_writable_splat(&self.to)?;
        splat_out::check_origin(&self.to, self.local_origin)?;
        let capture = self.scene.as_deref().map(open_capture).transpose()?;
        let mut inputs = InputFiles::default();
        capture.iter().for_each(|capture| capture.add_input_files(&mut inputs));
        inputs.check_file(&self.to)?;
        let original = read_splat_without_invalid(&self.from)?;
        warn(&original.warnings);
        // The input is described before the output replaces it, in case they are the same file.
        let from = description(&self.from, &original)?;
        let degree = self.sh_degree.map_or(original.sh_degree, |degree| degree as usize);
        let limits = match self.for_viewers {
            true => ShLimits::for_viewers(degree),
            false => ShLimits::up_to(degree),
        };
        let fit = |cameras: &[Camera]| fit_splat(&self.to, &original, &limits, cameras);
        let fitted = match &capture {
            Some(capture) => Some(fit(&capture.cameras())?),
            // The writer clamps by itself.
            None if !self.for_viewers => None,
            None => Some(fit(&[])?),
        };
        let written = fitted.as_ref().unwrap_or(&original).with_sh_degree(degree);
        let origin = self.local_origin.then(|| match &capture {
            Some(capture) => LocalFrame::from_cameras(&capture.cameras()).origin,
            // A splat that already has an origin keeps it.
            None if original.origin != DVec3::ZERO => original.origin,
            None => splat_frame(&original).origin,
        });
        splat_out::write(&self.to, &written, origin)?;
        let copy = read_splat(&self.to)?;
        let to = description(&self.to, &copy)?;

        let cameras = match &capture {
            Some(capture) => capture.cameras(),
            None => orbit_around_gaussians(&Gaussians::from_splat(&original), original.origin, SIZE, VIEWS),
        };
        if capture.is_none() {
            self.tell_cut(&original, &fit(&[])?);
        }
        let psnr = psnr_between(&original, &copy, &cameras)?;
        let views = cameras.len();
        if self.json {
            let report = json!({ "from": from, "to": to, "views": views, "psnr": psnr, "same_pixels": psnr.is_none() });
            print_json(&report);
        } else {
            let loss = match psnr {
                Some(psnr) => format!("{psnr:.2} dB between renders of both"),
                None => "the same pixels".into(),
            };
            println!("{}\n{}\n{views} views: {loss}", line(&from), line(&to));
        }
        Ok(())
    }

    /// Warns if coefficients are out of the representable range and no capture was given to fit the others to.
    fn tell_cut(&self, original: &Splat, held: &Splat) {
        let coefficients = |index: usize| {
            let pairs = original.sh_of(index).iter().zip(held.sh_of(index));
            pairs.flat_map(|(original, held)| original.iter().zip(held))
        };
        let cut = (0..held.len()).flat_map(coefficients).filter(|(original, held)| original != held).count();
        let share = 100. * cut as f64 / (3 * held.sh.len()) as f64;
        if share > 0. {
            let who = if self.for_viewers { "viewers hold" } else { "the format holds" };
            eprintln!(
                "{}: {share:.1} % of the colours' coefficients are beyond what {who} and cut off; --scene, with the cameras that \
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
        "bytes": std::fs::metadata(path)?.len(),
    }))
}

fn line(report: &Value) -> String {
    let name = report["splat"].as_str().unwrap_or_default();
    format!(
        "{name}: {} Gaussians, SH degree {}, {} bytes",
        report["gaussians"], report["sh_degree"], report["bytes"]
    )
}
