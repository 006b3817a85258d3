//! Pinhole views of a photo whose lens is not a perspective one (spec 10.5).

use super::{Lens, LensModel, MAX_ANGLE};
use crate::geometry::{ImageSize, Intrinsics};
use glam::{DMat3, DVec2, DVec3};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Largest tangent of the angle between a view's axis and the rays of its left, right, upper and lower edges, unless the view is a
/// face of a cube: 55 degrees.
const MAX_TANGENT: f64 = 1.428_148_006_742_114_4;

/// A pinhole view that shows a part of a photo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PinholeView {
    /// Word that distinguishes the view from the photo's others, or an empty string if there are none.
    pub suffix: &'static str,
    /// Rotation from the view's camera axes to the photo's.
    pub rotation: DMat3,
    pub intrinsics: Intrinsics,
    pub size: ImageSize,
}

/// Mapping from the rays of a pinhole view to its photo.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Projection {
    /// Lens of the photo.
    pub lens: Lens,
    /// Rotation from the view's camera axes to the photo's.
    pub rotation: DMat3,
}

impl Projection {
    /// Returns `true` if the view is the photo.
    pub fn is_identity(&self) -> bool {
        self.lens.model == LensModel::default()
    }

    /// Returns the position in the photo of the view's ray `ray`, or `None` if the photo doesn't show it.
    pub fn position(&self, ray: DVec3) -> Option<DVec2> {
        self.lens.project_into_photo(self.rotation * ray)
    }
}

/// Returns pinhole views that together show every ray of the photos of `lens`. The views are the first of these that fit:
///
/// 1. one view, if no ray is further than 55 degrees from the axis, horizontally and vertically;
/// 2. two views beside or above each other, each within that field, if the photo is a wide or a tall one;
/// 3. the faces of a cube of which the photo shows something.
///
/// The focal length is the number of pixels per radian at the photo's optical axis. It is shorter if the views would have more than
/// 16 times as many pixels as the photo, which only a lens has that enlarges its center out of all proportion. Every view is cut to
/// what the photo shows, and contains its own axis.
pub(crate) fn split_into_views(lens: &Lens) -> Vec<PinholeView> {
    const MAX_PIXELS: f64 = 16.;
    let Intrinsics { fx, fy, .. } = lens.intrinsics;
    let focal = (fx * fy).sqrt() * lens.model.central_scale();
    let views = split_with_focal(lens, focal);
    let pixels = |size: ImageSize| f64::from(size.width) * f64::from(size.height);
    let excess = views.iter().map(|view| pixels(view.size)).sum::<f64>() / (MAX_PIXELS * pixels(lens.size));
    if excess > 1. { split_with_focal(lens, focal / excess.sqrt()) } else { views }
}

fn split_with_focal(lens: &Lens, focal: f64) -> Vec<PinholeView> {
    if lens.model == LensModel::Equirectangular {
        return cube(lens, focal);
    }
    let rays = outline(lens);
    let side = |angle: fn(DVec3) -> f64| rays.iter().map(|&ray| angle(ray).abs()).fold(0., f64::max);
    let (across, down) = (side(|ray| ray.x.atan2(ray.z)), side(|ray| ray.y.atan2(ray.z)));
    let beside =
        [("left", DMat3::from_rotation_y(-across / 2.)), ("right", DMat3::from_rotation_y(across / 2.))];
    let above = [("up", DMat3::from_rotation_x(down / 2.)), ("down", DMat3::from_rotation_x(-down / 2.))];
    let one = || views(&[("", DMat3::IDENTITY)], |_, _| true, &rays, focal);
    let beside = || views(&beside, |view, ray| (ray.x < 0.) == (view == 0), &rays, focal);
    let above = || views(&above, |view, ray| (ray.y < 0.) == (view == 0), &rays, focal);
    let two = || if across >= down { beside().or_else(above) } else { above().or_else(beside) };
    one().or_else(two).unwrap_or_else(|| cube(lens, focal))
}

/// Returns rays around everything that the photo shows, and some inside.
fn outline(lens: &Lens) -> Vec<DVec3> {
    // Numbers of parts of each edge of the photo, of parts of the photo along a side, and of directions around the axis.
    const EDGE: u32 = 256;
    const INSIDE: u32 = 16;
    const AROUND: u32 = 720;
    let size = DVec2::new(lens.size.width.into(), lens.size.height.into());
    let edges = (0..=EDGE).flat_map(|i| {
        let at = f64::from(i) / f64::from(EDGE);
        [DVec2::new(at, 0.), DVec2::new(at, 1.), DVec2::new(0., at), DVec2::new(1., at)]
    });
    let points = edges.map(|point| size * point).chain(lens.grid(INSIDE));
    let mut rays: Vec<DVec3> = points.filter_map(|point| lens.unproject_used(point)).collect();
    // Where the field ends inside the photo.
    let end = match lens.model {
        LensModel::Fisheye(fisheye) => fisheye.max_angle.min(MAX_ANGLE),
        _ => MAX_ANGLE,
    };
    let (sin, cos) = (end - 1e-9).sin_cos();
    rays.extend((0..AROUND).filter_map(|i| {
        let (y, x) = (TAU * f64::from(i) / f64::from(AROUND)).sin_cos();
        let ray = DVec3::new(x * sin, y * sin, cos);
        lens.project_into_photo(ray).map(|_| ray)
    }));
    rays
}

/// Returns the views of the given names and rotations, of which view i shows the `rays` for which `is_shown`(i, ray) holds. Returns
/// `None` if a ray is outside the field that a view may have.
fn views(
    rotations: &[(&'static str, DMat3)],
    is_shown: impl Fn(usize, DVec3) -> bool,
    rays: &[DVec3],
    focal: f64,
) -> Option<Vec<PinholeView>> {
    let view = |(index, &(suffix, rotation)): (usize, &(&'static str, DMat3))| {
        let rays = rays.iter().filter(|&&ray| is_shown(index, ray)).map(|&ray| rotation.transpose() * ray);
        let is_within = |ray: &DVec3| ray.z > 0. && ray.truncate().abs().max_element() <= MAX_TANGENT * ray.z;
        let points = rays.map(|ray| Some(ray).filter(is_within).map(|ray| ray.truncate() / ray.z));
        let [least, greatest] = bounds(points.collect::<Option<Vec<_>>>()?)?;
        // Views beside or above each other meet in a plane through the photo's axis.
        let axis = rotation.transpose() * DVec3::Z;
        let meeting = axis.truncate() / axis.z;
        Some(pinhole_view(suffix, rotation, [least.min(meeting), greatest.max(meeting)], focal, 0.5))
    };
    rotations.iter().enumerate().map(view).collect()
}

/// Returns the faces of a cube around the camera, each cut to what the photo shows of it. Faces of which it shows nothing are left
/// out.
fn cube(lens: &Lens, focal: f64) -> Vec<PinholeView> {
    /// Number of parts of a face along a side.
    const PARTS: u32 = 64;
    let faces = [
        ("front", DMat3::IDENTITY),
        ("right", DMat3::from_rotation_y(FRAC_PI_2)),
        ("back", DMat3::from_rotation_y(PI)),
        ("left", DMat3::from_rotation_y(-FRAC_PI_2)),
        ("up", DMat3::from_rotation_x(FRAC_PI_2)),
        ("down", DMat3::from_rotation_x(-FRAC_PI_2)),
    ];
    let part = 2. / f64::from(PARTS);
    let at = |i: u32| f64::from(i) * part - 1.;
    let view = |(suffix, rotation)| {
        let points = (0..=PARTS).flat_map(|i| (0..=PARTS).map(move |j| DVec2::new(at(j), at(i))));
        let is_shown = |point: &DVec2| lens.project_into_photo(rotation * point.extend(1.)).is_some();
        let [least, greatest] = bounds(points.filter(is_shown))?;
        let bounds = [(least - part).max(DVec2::NEG_ONE), (greatest + part).min(DVec2::ONE)];
        Some(pinhole_view(suffix, rotation, bounds, focal, 0.))
    };
    faces.into_iter().filter_map(view).collect()
}

/// Returns the least and the greatest x/z and y/z of `points` and of the view's axis, or `None` if there are no points.
fn bounds(points: impl IntoIterator<Item = DVec2>) -> Option<[DVec2; 2]> {
    let mut points = points.into_iter().peekable();
    points.peek()?;
    Some(points.fold([DVec2::ZERO; 2], |[least, greatest], point| [least.min(point), greatest.max(point)]))
}

/// Returns the view whose image contains the rays from `least` to `greatest`, as x/z and y/z, and `margin` pixels around them.
fn pinhole_view(
    suffix: &'static str,
    rotation: DMat3,
    [least, greatest]: [DVec2; 2],
    focal: f64,
    margin: f64,
) -> PinholeView {
    let first = (least * focal - margin).floor();
    let count = (greatest * focal + margin).ceil() - first;
    let [width, height] = count.to_array().map(|count| count.max(1.) as u32);
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: -first.x, cy: -first.y };
    PinholeView { suffix, rotation, intrinsics, size: ImageSize { width, height } }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rayon::prelude::*;

    fn lens(model: &str, parameters: &[f64], width: u32, height: u32) -> Lens {
        Lens::from_colmap(model, parameters, ImageSize { height, width }).expect(model)
    }

    /// Returns lenses of all fields of view, and the parts that their photos are split into.
    fn lenses() -> Vec<(Lens, &'static [&'static str])> {
        let beside: &[&str] = &["left", "right"];
        let above: &[&str] = &["up", "down"];
        let front: &[&str] = &["front", "right", "left", "up", "down"];
        let all: &[&str] = &["front", "right", "back", "left", "up", "down"];
        let opencv = |f: f64, width: u32, height: u32| {
            let (w, h) = (f64::from(width), f64::from(height));
            lens("OPENCV_FISHEYE", &[f, 1.01 * f, 0.49 * w, 0.52 * h, 0.03, -0.01, 0.002, 0.], width, height)
        };
        let fold = lens("RADIAL_FISHEYE", &[100., 125., 115., -0.2, 0.], 250, 230);
        vec![
            (opencv(210., 320, 240), &[""]),
            (opencv(105., 320, 155), beside),
            (opencv(105., 155, 320), above),
            (opencv(100., 320, 320), front),
            // 220 degrees and more, to which the photo is cut.
            (lens("FISHEYE", &[80., 80., 161., 158.], 320, 320), front),
            (lens("SIMPLE_FISHEYE", &[55., 160., 160.], 320, 320), front),
            (lens("RAD_TAN_THIN_PRISM_FISHEYE", &RAD_TAN, 352, 352), front),
            (lens("THIN_PRISM_FISHEYE", &THIN_PRISM, 360, 240), &[""]),
            // Radial distortion that turns back at 74 degrees.
            (fold, front),
            (lens("FOV", &[200., 205., 202., 145., 0.7], 400, 300), &[""]),
            (lens("EUCM", &[140., 140., 162., 80., 0.55, 1.1], 320, 160), beside),
            (lens("DIVISION", &[100., 105., 162., 118., -0.25], 320, 240), front),
            (lens("EQUIRECTANGULAR", &[320., 160.], 320, 160), all),
            (lens("EQUIRECTANGULAR", &[101., 50.], 101, 50), all),
        ]
    }

    const RAD_TAN: [f64; 16] = [
        120., 120., 176., 176., 0.4, -0.5, 0.2, 0.1, -0.15, 0.04, -0.001, 0.002, 0.001, -0.0002, 0.001,
        0.0002,
    ];
    const THIN_PRISM: [f64; 12] =
        [250., 249., 178., 123., -0.03, 0.01, 0.001, -0.002, 0.001, 0.0, 0.002, -0.001];

    /// Returns `true` if the image of `view` shows `ray`, in the view's axes.
    fn is_inside(view: &PinholeView, ray: DVec3) -> bool {
        let Intrinsics { fx, fy, cx, cy } = view.intrinsics;
        let point = DVec2::new(fx * ray.x / ray.z + cx, fy * ray.y / ray.z + cy);
        let size = DVec2::new(view.size.width.into(), view.size.height.into());
        let rounding = 1e-9;
        ray.z > 0. && point.min_element() >= -rounding && (size - point).min_element() >= -rounding
    }

    #[test]
    fn every_pixel_of_a_photo_is_in_a_view() {
        lenses().into_par_iter().for_each(|(lens, names)| {
            let views = split_into_views(&lens);
            assert_eq!(views.iter().map(|view| view.suffix).collect::<Vec<_>>(), names, "{lens:?}");
            let ImageSize { width, height } = lens.size;
            let mut count = 0;
            for (x, y) in (0..width).flat_map(|x| (0..height).map(move |y| (x, y))) {
                let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let Some(ray) = lens.unproject_used(pixel) else { continue };
                count += 1;
                let rays = views.iter().map(|view| (view, view.rotation.transpose() * ray));
                let mut shown = rays.filter(|(view, ray)| is_inside(view, *ray)).peekable();
                assert!(shown.peek().is_some(), "{pixel} of {lens:?} in {views:?}");
                for (view, ray) in shown {
                    // The view takes the color of its ray from the pixel.
                    let projection = Projection { lens, rotation: view.rotation };
                    let found = projection.position(ray).unwrap_or_else(|| panic!("{pixel} of {lens:?}"));
                    assert!((found - pixel).length() < 1e-6, "{found} for {pixel} of {lens:?}");
                }
            }
            assert!(count * 4 > width * height, "{count} pixels of {lens:?}");
        });
    }

    /// A file can claim any parameters, and views have to fit into memory.
    #[test]
    fn views_have_no_more_pixels_than_the_photo_has_many_times() {
        let pixels = |size: ImageSize| size.width * size.height;
        for lens in [
            lens("EUCM", &[1e6, 1e6, 32., 24., 0.99, 1e10], 64, 48),
            lens("EUCM", &[1e9, 1e9, 0.5, 0.5, 0.99, 1e16], 1, 1),
        ] {
            let found: u32 = split_into_views(&lens).iter().map(|view| pixels(view.size)).sum();
            // Sizes are rounded up.
            assert!(found <= 16 * pixels(lens.size) + 6 * 64, "{found} pixels");
        }
    }

    #[test]
    fn views_are_no_larger_than_what_the_photo_shows() {
        for (lens, _) in lenses() {
            let focal = (lens.intrinsics.fx * lens.intrinsics.fy).sqrt() * lens.model.central_scale();
            for view in split_into_views(&lens) {
                assert!((view.rotation.transpose() * view.rotation).abs_diff_eq(DMat3::IDENTITY, 1e-15));
                let Intrinsics { fx, fy, cx, cy } = view.intrinsics;
                assert!(fx == focal && fy == focal);
                view.intrinsics.check(view.size.width, view.size.height).unwrap();
                let [width, height] = [view.size.width, view.size.height].map(f64::from);
                let extents = [cx, width - cx, cy, height - cy];
                assert!(extents.iter().all(|extent| extent / focal <= MAX_TANGENT + 2. / focal), "{view:?}");
                // Every edge that isn't at the axis or at the end of a face has a pixel that is shown near it.
                let projection = Projection { lens, rotation: view.rotation };
                let is_shown = |u: f64, v: f64| {
                    projection.position(DVec3::new((u - cx) / focal, (v - cy) / focal, 1.)).is_some()
                };
                let margin = 2. + focal / 16.;
                let along = |size: f64| (0..=200).map(move |i| size * f64::from(i) / 200.);
                let shows = [
                    along(height).any(|v| is_shown(margin, v)),
                    along(height).any(|v| is_shown(width - margin, v)),
                    along(width).any(|u| is_shown(u, margin)),
                    along(width).any(|u| is_shown(u, height - margin)),
                ];
                for (shows, extent) in shows.into_iter().zip(extents) {
                    assert!(shows || extent < margin, "{view:?} of {lens:?}");
                }
            }
        }
    }
}
