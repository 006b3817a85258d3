//! Output of a refinement's result.

use super::super::print_json;
use globalsplat::metrics::CaptureScores;
use globalsplat::refine::{Correction, EvalPoint, RefineResult, RefineSession, SampleScores};
use serde_json::json;
use std::path::Path;

/// Prints the result that was written to `out`, as one JSON object if `is_json`. Scores are those before and after the optimization.
pub fn print_result(
    out: &Path,
    is_json: bool,
    session: &RefineSession,
    result: &RefineResult,
    held_out: Option<&[CaptureScores; 2]>,
    lpips: Option<&[CaptureScores; 2]>,
) {
    let RefineResult { steps, seconds: [begun, ended], shown: [before, after], corrections, .. } = result;
    let (count, photos) = (result.gaussians.count(), session.photos().len());
    // Scores are of the held-out views if there are any, else of the photos.
    let distances = lpips.map_or([None; 2], |scores| scores.each_ref().map(|scores| scores.mean.lpips_vgg));
    let (of_photos, of_held_out) =
        if session.held_out().is_empty() { (distances, [None; 2]) } else { ([None; 2], distances) };
    let scores =
        |psnr: f64, ssim: f64, lpips: Option<f64>| json!({ "psnr": psnr, "ssim": ssim, "lpips_vgg": lpips });
    if is_json {
        let of = |scores_of: &SampleScores, lpips| scores(scores_of.psnr, scores_of.ssim, lpips);
        let mut object = json!({
            "splat": out.to_string_lossy(), "gaussians": count, "photos": photos, "near_duplicates": session.near_duplicates(),
            "steps": steps, "seconds": ended, "begin_seconds": begun, "corrections": corrections,
            "shown": { "before": of(before, of_photos[0]), "after": of(after, of_photos[1]) },
        });
        if let Some([before, after]) = held_out {
            let of = |of: &CaptureScores, lpips| scores(of.mean.psnr, of.mean.ssim, lpips);
            let scores = session.sample_scores(after);
            let last = EvalPoint { seconds: *ended, steps: *steps, scores };
            let curve: Vec<&EvalPoint> = result.curve.iter().chain([&last]).collect();
            object["held_out"] = json!({
                "views": after.views.len(), "before": of(before, of_held_out[0]),
                "after": of(after, of_held_out[1]), "curve": curve,
            });
        }
        print_json(&object);
        return;
    }
    println!("{}: {count} Gaussians, {steps} steps, {ended:.0} s", out.display());
    println!("{:<24} {:>14} {:>8} {:>8}", "", "PSNR before", "after", "SSIM");
    let row = |name: String, [before, after]: [f64; 2], ssim: f64| {
        println!("{name:<24} {before:>14.2} {after:>8.2} {ssim:>8.4}");
    };
    let sampled = result.shown_photos;
    let of_photos = if sampled < photos { format!("{sampled} of ") } else { String::new() };
    row(format!("{of_photos}{photos} photos"), [before.psnr, after.psnr], after.ssim);
    if let Some([before, after]) = held_out {
        let (scored, all) = (after.views.len(), session.held_out().len());
        let of_all = if scored < all { format!(" of {all}") } else { String::new() };
        let psnr = [before.mean.psnr, after.mean.psnr];
        row(format!("{scored}{of_all} views held out"), psnr, after.mean.ssim);
    }
    if let [Some(before), Some(after)] = distances {
        println!("LPIPS (VGG) {before:.4} before, {after:.4} after");
    }
    if let Some(line) = describe_corrections(corrections) {
        println!("{line}");
    }
}

/// Describes the largest learned corrections in one line, or returns `None` if there are none.
fn describe_corrections(corrected: &[Correction]) -> Option<String> {
    let largest = |number: fn(&Correction) -> f64| corrected.iter().map(number).reduce(f64::max);
    let factor = |of: &Correction| of.exposure.map(|gain| gain.max(1. / gain)).into_iter().fold(1., f64::max);
    let (degrees, depths, factor) = (largest(|of| of.degrees)?, largest(|of| of.depths)?, largest(factor)?);
    let cameras = format!("{degrees:.2}° and {depths:.4} of the scene's depth (cameras)");
    let exposures = format!("a factor of {factor:.3} (exposures)");
    let kinds = [(degrees > 0. || depths > 0., cameras), (factor > 1., exposures)];
    let changed: Vec<String> =
        kinds.into_iter().filter(|(is_any, _)| *is_any).map(|(_, line)| line).collect();
    (!changed.is_empty()).then(|| format!("corrected at most by: {}", changed.join(", ")))
}
