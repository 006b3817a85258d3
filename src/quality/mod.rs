//! Quality of a capture, told before the time of a refinement is spent: whether its poses fit its photos, whether the photos show enough
//! parallax and are connected, which of them are blurred or badly exposed, and where more should be taken.

mod consistency;
mod coverage;
mod page;
mod photo;

pub use coverage::NextPhoto;
pub use page::write_quality_page;
pub use photo::PhotoQuality;

use crate::data::{Capture, PhotoSize, View, read_in_batches, read_points};
use crate::error::{Error, Result};
use crate::scene::{Camera, LocalFrame};
use crate::stereo::{
    ComparablePhoto, DepthMap, PhotoSurface, PlaneSweepOutput, SWEEP_SIDE, SmallPhoto, sweep,
};
use consistency::{Connections, Pair, compare_pairs};
use coverage::Coverage;
use glam::DVec3;
use globalsplat_capture::format_names;
use serde::Serialize;
use std::fmt;

/// Longer side in pixels at which sharpness is measured.
const MEASURED_SIDE: u32 = 1024;
/// Number of photos that a sentence names.
const SHOWN_NAMES: usize = 3;

/// Fractions of the pairs of photos that contradict their poses, from which on a capture is usable only, and will fail.
const CONTRADICTING: (f64, f64) = (0.1, 0.25);
/// Fractions of the textured patches on whose depths photos agree, below which a capture is usable only, and will fail.
const AGREEING: (f64, f64) = (0.35, 0.15);
/// Parallax in degrees below which a capture is usable only, and will fail.
const PARALLAX: (f64, f64) = (2., 0.3);
/// Minimum cosine of the angle between the axes of cameras that look in similar directions.
const SIMILAR_DIRECTION: f64 = 0.5;
/// Fraction of the photos that may be blurred, or badly exposed, or in no group with the others.
const MAX_DOUBTFUL: f64 = 0.2;
/// Fractions of the photos that were registered, below which a capture is usable only, and will fail.
const REGISTERED: (f64, f64) = (0.8, 0.3);
/// Mean reprojection error in pixels from which on a capture is usable only.
const REPROJECTION_ERROR: f64 = 1.5;
/// Number of photos below which a capture is usable only.
const FEW_PHOTOS: usize = 5;
/// Fraction of the surfaces that fewer than three photos show, from which on a capture is usable only.
const MAX_RARELY_SEEN: f64 = 0.4;
/// Fraction of the patches that have texture, below which a capture is usable only.
const MIN_TEXTURED: f64 = 0.1;

/// What to expect of a capture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Nothing stands in the way of a good splat.
    Good,
    /// A splat will have visible faults.
    Usable,
    /// A splat will not look like the photos.
    WillFail,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Verdict::Good => "good",
            Verdict::Usable => "usable",
            Verdict::WillFail => "will fail",
        })
    }
}

/// Result of an estimate of poses, as structure from motion reports it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Registration {
    /// Number of photos.
    pub photos: usize,
    /// Number of photos that got a pose.
    pub registered: usize,
    /// Mean reprojection error in pixels.
    pub reprojection_error: f64,
}

/// Quality of a capture.
#[derive(Debug, Clone, Serialize)]
pub struct CaptureQuality {
    /// Verdict, the worst of all reasons.
    pub verdict: Verdict,
    /// Reasons why it isn't good, in sentences without a full stop, the worst first.
    pub reasons: Vec<String>,
    /// Result of the estimate of poses, if it is known.
    pub registration: Option<Registration>,
    /// Median over photos of the largest parallax to a photo that looks in a similar direction, in degrees: their distance in units of the
    /// scene's depth.
    pub parallax: f64,
    /// Fraction of the photos' patches that have texture.
    pub textured: f64,
    /// Fraction of the textured patches on whose depths the plane sweep's photos agree.
    pub agreeing: f64,
    /// Fraction of the pairs of photos with a common surface that don't look alike there, as one photo's depths and the poses predict.
    pub contradicting: f64,
    /// Numbers of photos in the groups that consistent pairs connect, the largest first.
    pub groups: Vec<usize>,
    /// Fraction of the surfaces that fewer than three photos show.
    pub rarely_seen: f64,
    /// Up to three photos to take next, which show most of the surfaces that too few photos show.
    pub next_photos: Vec<NextPhoto>,
    /// Quality of each photo.
    pub photos: Vec<PhotoQuality>,
    /// Positions of surfaces in the capture's world, and the number of photos that show each.
    #[serde(skip)]
    surfaces: Vec<(DVec3, usize)>,
}

impl CaptureQuality {
    /// Measures the quality of `capture`. `registration` is the result of the estimate of its poses. `should_continue` is called with the
    /// number of photos that are done, and ends the work if it returns `false`; the result is `None` then.
    ///
    /// # Errors
    /// Fails if a photo or the points of the capture can't be read, if a photo is too small, or if fewer than two aren't masked out.
    pub fn measure(
        capture: &Capture,
        registration: Option<Registration>,
        mut should_continue: impl FnMut(usize) -> bool,
    ) -> Result<Option<Self>> {
        let count = capture.len();
        let (indices, size) = ((0..count).collect::<Vec<_>>(), PhotoSize::Within(MEASURED_SIDE));
        let mut measured = vec![];
        let measure = |views: Vec<View>| {
            let counted = views.iter().filter(|view| !view.is_masked_out());
            measured
                .extend(counted.map(|view| (PhotoQuality::measure(view), view.to_small_photo(SWEEP_SIDE))));
        };
        if !read_in_batches(capture, &indices, size, &mut should_continue, measure)? {
            return Ok(None);
        }
        if measured.len() < 2 {
            let field = "the number of photos that aren't masked out";
            return Err(Error::input(capture.file(), field, measured.len(), "2 or more"));
        }
        let (photos, small): (Vec<PhotoQuality>, Vec<SmallPhoto>) = measured.into_iter().unzip();
        let swept = sweep(small, &read_points(capture)?, |_| should_continue(count));
        Ok(swept.is_complete.then(|| CaptureQuality::new(photos, registration, &swept)))
    }

    /// Measures the quality of the capture of `views`, whose depths are `swept`.
    pub(crate) fn of_views(views: &[View], swept: &PlaneSweepOutput) -> Self {
        CaptureQuality::new(views.iter().map(PhotoQuality::measure).collect(), None, swept)
    }

    /// Returns the quality with positions in world coordinates, of one with positions in `frame`.
    pub(crate) fn in_world(mut self, frame: &LocalFrame) -> Self {
        let to_world = |position: &mut DVec3| *position = frame.point_to_world(*position);
        self.surfaces.iter_mut().for_each(|(position, _)| to_world(position));
        self.next_photos.iter_mut().for_each(|photo| {
            to_world(&mut photo.position);
            to_world(&mut photo.look_at);
        });
        self
    }

    fn new(
        mut photos: Vec<PhotoQuality>,
        registration: Option<Registration>,
        swept: &PlaneSweepOutput,
    ) -> Self {
        let surfaces: Vec<(usize, PhotoSurface)> =
            swept.depth_maps.iter().map(|(index, map)| (*index, PhotoSurface::new(map))).collect();
        let comparable = ComparablePhoto::of_sweep(swept);
        let pairs = compare_pairs(swept, &surfaces, &comparable);
        let share = |part: usize, all: usize| part as f64 / all.max(1) as f64;
        let contradicting = pairs.iter().filter(|pair| !pair.is_consistent).count();
        let distinct = pairs.iter().filter(|pair| !pair.is_near_duplicate).count();
        for (index, photo) in photos.iter_mut().enumerate() {
            let of_photo: Vec<&Pair> = pairs.iter().filter(|pair| pair.photos.contains(&index)).collect();
            let against = of_photo.iter().filter(|pair| !pair.is_consistent).count();
            photo.contradicting = (!of_photo.is_empty()).then(|| share(against, of_photo.len()));
        }
        let patches = || surfaces.iter().flat_map(|(_, surface)| &surface.patches);
        let textured = patches().filter(|patch| patch.is_textured).count();
        let sure = patches().filter(|patch| patch.is_textured && patch.is_sure).count();
        let with_depths: Vec<usize> = swept.depth_maps.iter().map(|(index, _)| *index).collect();
        let connections = Connections::new(photos.len(), &with_depths, &pairs);
        let coverage = Coverage::new(&surfaces, &comparable);
        let mut quality = CaptureQuality {
            verdict: Verdict::Good,
            reasons: vec![],
            registration,
            parallax: median_parallax(swept),
            textured: share(textured, patches().count()),
            agreeing: share(sure, textured),
            contradicting: share(contradicting, distinct),
            groups: connections.groups.iter().map(Vec::len).collect(),
            rarely_seen: coverage.rarely_seen_share(),
            surfaces: coverage.points().collect(),
            next_photos: coverage.next_photos(swept),
            photos,
        };
        let mut reasons = quality.find_reasons(&connections);
        reasons.sort_by_key(|(verdict, _)| std::cmp::Reverse(*verdict));
        quality.verdict = reasons.first().map_or(Verdict::Good, |(verdict, _)| *verdict);
        quality.reasons = reasons.into_iter().map(|(_, reason)| reason).collect();
        quality
    }

    /// Returns what stands in the way of a good splat, and what follows from each.
    fn find_reasons(&self, connections: &Connections) -> Vec<(Verdict, String)> {
        let mut reasons = vec![];
        let mut add = |verdict: Option<Verdict>, reason: String| {
            reasons.extend(verdict.map(|verdict| (verdict, reason)))
        };
        let percent = |share: f64| format!("{:.0} %", 100. * share);
        let name = |photo: &usize| self.photos[*photo].name.clone();
        let names =
            |photos: &[usize]| format_names(&photos.iter().map(name).collect::<Vec<_>>(), SHOWN_NAMES);
        let count = self.photos.len();

        if let Some(Registration { photos, registered, reprojection_error }) = self.registration {
            let share = registered as f64 / photos.max(1) as f64;
            add(verdict_below(share, REGISTERED), format!("only {registered} of {photos} photos have poses"));
            let is_large = reprojection_error > REPROJECTION_ERROR;
            add(
                is_large.then_some(Verdict::Usable),
                format!("the reprojection error is {reprojection_error:.1} pixels"),
            );
        }
        add((count < FEW_PHOTOS).then_some(Verdict::Usable), format!("there are only {count} photos"));
        let parallax = verdict_below(self.parallax, PARALLAX);
        // Few textured patches tell little.
        let agreeing = verdict_below(self.agreeing, AGREEING).filter(|_| self.textured > MIN_TEXTURED);
        let percentage = percent(self.agreeing);
        // Photos from one place look alike at an infinite depth, or can't be compared at all.
        let is_one_place = parallax == Some(Verdict::WillFail)
            && (agreeing != Some(Verdict::WillFail) || self.agreeing == 0.);
        if is_one_place {
            let place = "the photos were taken from one place, which shows no depth: walk instead of turning";
            add(parallax, place.into());
        } else {
            add(parallax.min(Some(Verdict::Usable)), "the photos were taken from nearly one place".into());
            add(agreeing, format!("photos agree on the depth of only {percentage} of what has texture"));
            let percentage = percent(self.contradicting);
            let mut wrong = format!(
                "poses are wrong: {percentage} of the pairs of photos don't look alike where they should"
            );
            if connections.is_contradictory {
                let [first, second] = [0, 1].map(|group| names(&connections.groups[group]));
                wrong += &format!("; {first} don't fit {second}");
            }
            let fails = connections.is_contradictory.then_some(Verdict::WillFail);
            add(fails.or(verdict_above(self.contradicting, CONTRADICTING)), wrong);
        }
        let apart = &connections.apart;
        let is_apart = apart.len() as f64 > MAX_DOUBTFUL * count as f64
            && !connections.is_contradictory
            && !is_one_place;
        let line = format!("{} photos share too little with the others: {}", apart.len(), names(apart));
        add(is_apart.then_some(Verdict::Usable), line);
        if let Some((photo, part)) = &connections.articulation_photo {
            let line = format!(
                "{} alone connects {} photos with the others: {}",
                name(photo),
                part.len(),
                names(part)
            );
            add(Some(Verdict::Usable), line);
        }
        let doubtful: Vec<usize> =
            (0..count).filter(|&photo| self.photos[photo].has_doubtful_pose()).collect();
        let has_few = !doubtful.is_empty() && self.contradicting < CONTRADICTING.0;
        add(
            has_few.then_some(Verdict::Usable),
            format!("the poses of {} photos are doubtful: {}", doubtful.len(), names(&doubtful)),
        );
        for (what, is_bad) in [
            ("blurred", PhotoQuality::is_blurred as fn(&PhotoQuality) -> bool),
            ("too dark or too bright", PhotoQuality::is_clipped),
        ] {
            let bad: Vec<usize> = (0..count).filter(|&photo| is_bad(&self.photos[photo])).collect();
            let are_many = bad.len() as f64 > MAX_DOUBTFUL * count as f64;
            add(
                are_many.then_some(Verdict::Usable),
                format!("{} of {count} photos are {what}: {}", bad.len(), names(&bad)),
            );
        }
        let is_rarely_seen = self.rarely_seen > MAX_RARELY_SEEN;
        add(
            is_rarely_seen.then_some(Verdict::Usable),
            format!("{} of the surfaces are in fewer than three photos", percent(self.rarely_seen)),
        );
        let is_blank = self.textured < MIN_TEXTURED;
        add(
            is_blank.then_some(Verdict::Usable),
            format!("only {} of the photos has texture", percent(self.textured)),
        );
        reasons
    }
}

/// Formats the verdict and its reasons in one line.
impl fmt::Display for CaptureQuality {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let CaptureQuality { verdict, agreeing, parallax, .. } = self;
        match &self.reasons[..] {
            [] => write!(
                f,
                "{verdict}: photos agree on the depth of {:.0} % of what has texture, parallax {parallax:.0}°",
                100. * agreeing
            ),
            reasons => write!(f, "{verdict}: {}", reasons.join("; ")),
        }
    }
}

/// Returns what follows from a value that should not be below `limits`.
fn verdict_below(value: f64, (usable, fails): (f64, f64)) -> Option<Verdict> {
    if value < fails { Some(Verdict::WillFail) } else { (value < usable).then_some(Verdict::Usable) }
}

/// Returns what follows from a value that should not be above `limits`.
fn verdict_above(value: f64, (usable, fails): (f64, f64)) -> Option<Verdict> {
    verdict_below(-value, (-usable, -fails))
}

/// Returns the median over the photos with depths of the largest parallax to a photo that looks in a similar direction, in degrees.
fn median_parallax(swept: &PlaneSweepOutput) -> f64 {
    let cameras: Vec<Camera> = swept.photos.iter().map(|photo| photo.camera).collect();
    let largest = |(index, map): &(usize, DepthMap)| {
        let this = cameras[*index].c2w;
        let similar = cameras.iter().filter(|other| other.c2w.z_axis.dot(this.z_axis) > SIMILAR_DIRECTION);
        let distance = similar.map(|other| this.w_axis.distance(other.c2w.w_axis)).fold(0., f64::max);
        2. * (distance / (2. * map.median_depth())).atan().to_degrees()
    };
    let mut parallaxes: Vec<f64> = swept.depth_maps.iter().map(largest).collect();
    parallaxes.sort_by(f64::total_cmp);
    parallaxes[parallaxes.len() / 2]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::wall;
    use glam::DMat4;
    use tch::{Kind, Tensor};

    /// Returns a view of a wall whose pattern has sharp edges.
    fn sharp_wall(x: f64) -> View {
        let view = wall(x);
        let image = view.image.to_float();
        let edges = image.ge(0.4).to_kind(Kind::Float) * 0.3;
        View { image: (image * 0.5 + edges).into(), ..view }
    }

    /// Returns the quality of nine views of a wall, each changed by `change`.
    fn quality(change: impl Fn(usize, View) -> View) -> CaptureQuality {
        let view = |index: usize| change(index, sharp_wall(0.25 * index as f64 - 1.));
        let views: Vec<View> = (0..9).map(view).collect();
        let photos = views.iter().map(|view| view.to_small_photo(SWEEP_SIDE)).collect();
        CaptureQuality::of_views(&views, &sweep(photos, &[], |_| true))
    }

    fn with_pose(view: View, change: impl Fn(DMat4) -> DMat4) -> View {
        View { camera: Camera { c2w: change(view.camera.c2w), ..view.camera }, ..view }
    }

    #[test]
    fn right_poses_are_good_and_wrong_ones_will_fail() {
        let good = quality(|_, view| view);
        assert_eq!((good.verdict, &good.reasons[..]), (Verdict::Good, &[][..]), "{good}");
        assert!(good.contradicting == 0. && good.groups == [9] && good.agreeing > 0.8, "{good:?}");
        // The wall is at depth 4, and each camera has another one 1 to 2 beside it.
        assert!((15. ..30.).contains(&good.parallax), "{}", good.parallax);

        let turn = DMat4::from_rotation_y(0.1);
        let turned = quality(|index, view| with_pose(view, |c2w| if index < 4 { turn * c2w } else { c2w }));
        assert_eq!(turned.verdict, Verdict::WillFail, "{turned}");
        assert!(turned.to_string().starts_with("will fail: poses are wrong"), "{turned}");
        assert_eq!(turned.groups, [5, 4], "{turned:?}");

        let place = quality(|index, _| {
            with_pose(sharp_wall(0.), |c2w| DMat4::from_translation(DVec3::X * 1e-4 * index as f64) * c2w)
        });
        assert_eq!(place.verdict, Verdict::WillFail, "{place}");
    }

    #[test]
    fn blurred_and_overexposed_photos_are_named() {
        let blurred = |view: &View| {
            let image = view.image.to_float().unsqueeze(0);
            let image = (0..4).fold(image, |image, _| image.avg_pool2d(5, 1, 2, false, false, None));
            image.squeeze_dim(0)
        };
        let white = |view: &View| view.image.to_float() * 9.;
        for (change, what) in [
            (&blurred as &dyn Fn(&View) -> Tensor, "3 of 9 photos are blurred: "),
            (&white, "3 of 9 photos are too dark or too bright: "),
        ] {
            let found = quality(|index, view| match index % 3 {
                0 => View { image: change(&view).into(), ..view },
                _ => view,
            });
            assert_eq!(found.verdict, Verdict::Usable, "{found}");
            assert!(found.to_string().contains(what), "{found}");
            assert_eq!(found.photos.iter().filter(|photo| !photo.faults().is_empty()).count(), 3);
        }
    }
}
