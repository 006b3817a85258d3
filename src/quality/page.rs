//! Page that shows the quality of a capture: a self-contained HTML file.

use super::{CaptureQuality, NextPhoto, PhotoQuality, Verdict};
use crate::data::{Capture, PhotoSize, load_views};
use crate::error::Result;
use crate::io::{html_page, jpeg_data_url, write_file};
use crate::scene::Camera;
use glam::{DVec2, DVec3};
use maud::{Markup, html};
use std::collections::HashMap;
use std::path::Path;

const STYLE: &str = include_str!("page.css");
/// Longer side in pixels of the photos.
const PHOTO: u32 = 480;
/// Maximum number of photos, at about 60 KB each.
const MAX_PHOTOS: usize = 24;
/// Side of the map in its own units.
const MAP: f64 = 600.;
/// Maximum number of surfaces on the map.
const MAX_SURFACES: usize = 6000;
/// Fraction of the surfaces at each end that may be outside of the map.
const OUTSIDE: f64 = 0.1;

/// Writes a page with the verdict on `capture`, its figures, a map of its cameras and of the surfaces they show, the photos to take next, and
/// the doubtful photos.
///
/// # Errors
/// Fails if a photo can't be read, or if the file can't be written.
pub fn write_quality_page(path: &Path, capture: &Capture, quality: &CaptureQuality) -> Result<()> {
    let doubtful: Vec<usize> =
        (0..quality.photos.len()).filter(|&photo| !quality.photos[photo].faults().is_empty()).collect();
    let indices: HashMap<&str, usize> = capture.names().zip(0..).collect();
    let indices: Vec<usize> = quality.photos.iter().map(|photo| indices[&photo.name[..]]).collect();
    let all = capture.cameras();
    let cameras: Vec<Camera> = indices.iter().map(|&index| all[index]).collect();
    let title = format!("{}: {}", capture.name, quality.verdict);
    let class = match quality.verdict {
        Verdict::Good => "good",
        Verdict::Usable => "usable",
        Verdict::WillFail => "fails",
    };
    let body = html! {
        main {
            p { "Capture " (capture.name) }
            h1 class=(class) { (quality.verdict) }
            @if !quality.reasons.is_empty() { ul { @for reason in &quality.reasons { li { (reason) } } } }
            (figures(quality))
            h2 { "From above" }
            (map(&cameras, quality))
            (next_photos(&quality.next_photos))
            @if !doubtful.is_empty() { (doubtful_photos(capture, &indices, quality, &doubtful)?) }
            footer { "Written by globalsplat " (env!("CARGO_PKG_VERSION")) "." }
        }
    };
    write_file(path, html_page(&title, STYLE, &body).into_string())
}

impl PhotoQuality {
    /// Returns what is wrong with the photo, in words.
    pub(super) fn faults(&self) -> Vec<&'static str> {
        let faults = [
            (self.is_blurred(), "blurred"),
            (self.is_clipped(), "too dark or too bright"),
            (self.has_doubtful_pose(), "doubtful pose"),
        ];
        faults.into_iter().filter(|(is_so, _)| *is_so).map(|(_, fault)| fault).collect()
    }
}

fn figures(quality: &CaptureQuality) -> Markup {
    let percent = |share: f64| format!("{:.0} %", 100. * share);
    let registered = quality.registration.map(|of| {
        [
            ("photos with poses", format!("{} of {}", of.registered, of.photos)),
            ("reprojection error", format!("{:.2} pixels", of.reprojection_error)),
        ]
    });
    let others = [
        ("parallax", format!("{:.0}°", quality.parallax)),
        ("of the photos has texture", percent(quality.textured)),
        ("of it has a depth on which photos agree", percent(quality.agreeing)),
        ("of the pairs of photos contradict their poses", percent(quality.contradicting)),
        ("of the surfaces are in fewer than three photos", percent(quality.rarely_seen)),
    ];
    html! {
        dl {
            @for (name, value) in registered.into_iter().flatten().chain(others) { div { dt { (name) } dd { (value) } } }
        }
    }
}

/// Renders cameras, surfaces and the photos to take next as seen from above.
fn map(cameras: &[Camera], quality: &CaptureQuality) -> Markup {
    let down =
        cameras.iter().map(|camera| camera.c2w.y_axis.truncate()).sum::<DVec3>().normalize_or(DVec3::Y);
    let right =
        (cameras[0].c2w.x_axis.truncate().reject_from(down)).normalize_or(down.any_orthonormal_vector());
    let forward = right.cross(down);
    let flat = |position: DVec3| DVec2::new(position.dot(right), -position.dot(forward));
    let step = quality.surfaces.len().div_ceil(MAX_SURFACES).max(1);
    let surfaces: Vec<(DVec2, usize)> =
        quality.surfaces.iter().step_by(step).map(|&(position, count)| (flat(position), count)).collect();
    let centers: Vec<DVec2> = cameras.iter().map(|camera| flat(camera.c2w.w_axis.truncate())).collect();
    let range = |axis: fn(&DVec2) -> f64| {
        let mut values: Vec<f64> = surfaces.iter().map(|(at, _)| axis(at)).collect();
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values.get((share * values.len() as f64) as usize).copied();
        let centers = || centers.iter().map(axis);
        let low = centers().chain(at(OUTSIDE)).fold(f64::INFINITY, f64::min);
        let high = centers().chain(at(1. - OUTSIDE)).fold(f64::NEG_INFINITY, f64::max);
        (low, high)
    };
    let ((left, east), (top, bottom)) = (range(|at| at.x), range(|at| at.y));
    let side = (east - left).max(bottom - top).max(f64::MIN_POSITIVE) * 1.1;
    let middle = DVec2::new(left + east, top + bottom) / 2.;
    let place = |at: DVec2| (at - middle) / side * MAP + MAP / 2.;
    let class = |count: usize| ["one", "one", "two"].get(count).copied().unwrap_or("many");
    let is_inside = |at: &DVec2| at.min_element() > 0. && at.max_element() < MAP;
    html! {
        svg viewBox={ "0 0 " (MAP) " " (MAP) } role="img" aria-label="Map of cameras and surfaces" {
            @for (at, count) in &surfaces {
                @let at = place(*at);
                @if is_inside(&at) { circle class=(class(*count)) cx={ (format!("{:.0}", at.x)) } cy={ (format!("{:.0}", at.y)) } r="1.2" {} }
            }
            @for (camera, photo) in cameras.iter().zip(&quality.photos) {
                @let center = place(flat(camera.c2w.w_axis.truncate()));
                @let ahead = flat(camera.c2w.z_axis.truncate()).normalize_or_zero() * 14.;
                @let side = ahead.perp() * 0.45;
                @let corners = [center, center + ahead + side, center + ahead - side].map(|at| format!("{:.1},{:.1}", at.x, at.y));
                polygon class=(if photo.faults().is_empty() { "camera" } else { "doubtful" }) points=(corners.join(" ")) { title { (photo.name) } }
            }
            @for (number, next) in (1..).zip(&quality.next_photos) {
                @let at = place(flat(next.position));
                circle class="next" cx=(at.x) cy=(at.y) r="8" {}
                text x=(at.x) y=(at.y + 4.) { (number) }
            }
        }
        p.legend {
            span.one { "in one photo" } span.two { "in two" } span.many { "in three or more" } span.camera { "camera" }
            span.doubtful { "doubtful photo" } @if !quality.next_photos.is_empty() { span.next { "photo to take" } }
        }
    }
}

fn next_photos(next: &[NextPhoto]) -> Markup {
    html! {
        @if !next.is_empty() {
            h2 { "Photos to take next" }
            ol { @for photo in next { li { (photo) } } }
        }
    }
}

/// Renders the photos `doubtful`. `indices` are those of all photos in `capture`.
fn doubtful_photos(
    capture: &Capture,
    indices: &[usize],
    quality: &CaptureQuality,
    doubtful: &[usize],
) -> Result<Markup> {
    let cameras = capture.cameras();
    let photo = |&photo: &usize| -> Result<Markup> {
        let index = indices[photo];
        let view =
            load_views(capture, &[index], PhotoSize::Within(PHOTO).resized(&cameras[index]))?.remove(0);
        let source = jpeg_data_url(&view.image.to_float())?;
        let (name, faults) = (&view.name, quality.photos[photo].faults().join(", "));
        Ok(html! { figure { img src=(source) alt=(name); figcaption { b { (name) } ": " (faults) } } })
    };
    let shown: Vec<Markup> = doubtful.iter().take(MAX_PHOTOS).map(photo).collect::<Result<_>>()?;
    let left_out = doubtful.len() - shown.len();
    Ok(html! {
        h2 { (doubtful.len()) " doubtful " (if doubtful.len() == 1 { "photo" } else { "photos" }) }
        div.photos { @for photo in shown { (photo) } }
        @if left_out > 0 { p { "and " (left_out) " more" } }
    })
}
