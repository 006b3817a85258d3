use super::{print_json, progress, stop_flag};
use anyhow::Result;
use clap::Args;
use globalsplat::io::check_writable_dir;
use globalsplat_sfm::{Colmap, Matching, PoseOptions, Step, estimate_poses};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

/// Make a capture from a folder of photos: find their camera poses, by COLMAP.
///
/// COLMAP is the newer of the colmap on the PATH and pycolmap, which `make poses` or `pip install pycolmap` installs;
/// GLOBALSPLAT_COLMAP names a colmap, or a Python that has pycolmap. It runs on all cores, without a GPU and offline. Ctrl-C
/// stops it, and the same command continues. Photos that are damaged, of a single colour or identical to another are left
/// out.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat capture photos/room --out captures/room\n  \
    globalsplat capture photos/garden --out captures/garden --camera-model OPENCV_FISHEYE\n  \
    globalsplat capture photos/walk --out captures/walk --matching sequential")]
pub struct Capture {
    /// Folder of photos, JPEG or PNG, that show the same scene and overlap
    #[arg(value_name = "PHOTOS")]
    photos: PathBuf,
    /// Folder for the capture: images, sparse and capture.json
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Camera model of COLMAP; by default OPENCV for 10 or more photos of the same size, and SIMPLE_RADIAL for fewer
    #[arg(long, value_name = "MODEL")]
    camera_model: Option<String>,
    /// Pairs of photos to match: exhaustive: every pair; sequential: each photo with the next 10 by name and those nearby by GPS,
    /// and every pair among 64; auto: exhaustive for up to 200 photos, else sequential
    #[arg(long, value_name = "PAIRS", default_value = "auto", value_parser = str::parse::<Matching>)]
    matching: Matching,
    /// Print the result as one JSON object
    #[arg(long)]
    json: bool,
}

impl Capture {
    pub fn run(self) -> Result<()> {
        let colmap = Colmap::find()?;
        check_writable_dir(&self.out)?;
        eprintln!("{colmap}");
        let stop = stop_flag()?;
        let camera_model = self.camera_model.map(|model| model.to_uppercase());
        let options = PoseOptions { camera_model, matching: self.matching };
        let mut bar: Option<(Step, progress::Progress)> = None;
        let report = estimate_poses(&self.photos, &self.out, &options, &colmap, &mut |progress| {
            if bar.as_ref().is_none_or(|(step, _)| *step != progress.step) {
                let next = progress::bar(progress.total as u64, progress.step.unit());
                if let Some((_, finished)) = bar.replace((progress.step, next)) {
                    finished.finish_and_clear();
                }
            }
            if let Some((_, bar)) = &bar {
                bar.set_position(progress.done as u64);
            }
            !stop.load(Ordering::Relaxed)
        });
        if let Some((_, bar)) = bar {
            bar.finish_and_clear();
        }
        let out = self.out.display();
        let Some(report) = report? else { anyhow::bail!("stopped; the same command continues in {out}") };
        if self.json {
            let mut json = serde_json::to_value(&report)?;
            json["out"] = self.out.to_string_lossy().into();
            print_json(&json);
        } else {
            let splat = Path::new(self.out.file_name().unwrap_or("scene".as_ref())).with_extension("ply");
            println!("{out}: {report}");
            println!("next: globalsplat refine --scene {out} --out {}", splat.display());
        }
        Ok(())
    }
}
