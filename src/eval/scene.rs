//! Scenes for evaluation: context photos, which a method may see, and target photos, which it has to match, as an index or a holdout
//! splits them.

use super::depths::{ExactDepths, depth_error};
use crate::data::{Capture, Holdout, PhotoSize, View, load_views, read_points};
use crate::error::{Error, Result};
use crate::io::{read_text, write_json};
use crate::metrics::{CaptureScores, score_view};
use crate::reconstruct::{context_views, load_context};
use crate::scene::{Camera, ImageSize};
use crate::stereo::{DepthMap, SWEEP_SIDE, covered, sweep};
use glam::DMat4;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tch::Tensor;

/// Frames of one scene.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SceneFrames {
    /// Context frames, which the model sees.
    pub context: Vec<usize>,
    /// Target frames, which are rendered and scored.
    pub target: Vec<usize>,
}

impl SceneFrames {
    /// Splits a video of `count` frames, at least three: every other frame is context, and every other one of the rest is a target.
    pub fn alternating(count: usize) -> Self {
        SceneFrames { context: (0..count).step_by(2).collect(), target: (1..count).step_by(4).collect() }
    }

    /// Returns a checksum of the unmodified photo files of these frames, and of their cameras.
    ///
    /// # Errors
    /// Fails if a photo can't be read.
    pub(super) fn checksum(&self, capture: &Capture) -> Result<u32> {
        capture.checksum(self.context.iter().chain(&self.target).copied())
    }

    /// Returns the file names of the target images without their extensions: six-digit frame numbers, as chunks name frames.
    pub(super) fn render_names(&self) -> Vec<String> {
        self.target.iter().map(|frame| format!("{frame:06}")).collect()
    }
}

/// Contents of an index file: `{scene: {"context": [frames], "target": [frames]}}`. A scene that is null is left out.
#[derive(Debug, Clone)]
pub struct EvaluationIndex {
    /// Path of the index file.
    pub file: PathBuf,
    /// Frames of each scene, by the scene's key.
    pub scenes: BTreeMap<String, SceneFrames>,
}

impl EvaluationIndex {
    /// Reads an index from `file`.
    ///
    /// # Errors
    /// Fails if the file can't be read, is not an index, names no scene, or has a scene with fewer than two context frames or no target.
    pub fn read(file: &Path) -> Result<Self> {
        let expected = "{scene: {\"context\": [frames], \"target\": [frames]} or null}";
        let scenes: BTreeMap<String, Option<SceneFrames>> = serde_json::from_str(&read_text(file)?)
            .map_err(|e| Error::input(file, "the index", format!("unusable ({e})"), expected))?;
        let scenes: BTreeMap<_, _> =
            scenes.into_iter().filter_map(|(key, frames)| Some((key, frames?))).collect();
        if scenes.is_empty() {
            return Err(Error::input(file, "the index", "one without scenes", expected));
        }
        for (key, frames) in &scenes {
            let (context, target) = (frames.context.len(), frames.target.len());
            if context < 2 || target == 0 {
                let found = format!("{context} context and {target} target frames");
                return Err(Error::input(file, format!("scene {key}"), found, "2 and 1 at least"));
            }
        }
        Ok(EvaluationIndex { file: file.to_owned(), scenes })
    }

    /// Writes the index to [`EvaluationIndex::file`].
    ///
    /// # Errors
    /// Fails if the file can't be written.
    pub fn write(&self) -> Result<()> {
        write_json(&self.file, &self.scenes)
    }

    /// Returns the name of the index file.
    pub fn name(&self) -> String {
        self.file.file_name().unwrap_or_default().to_string_lossy().into_owned()
    }

    /// Returns the number of context frames of the first scene. Indices have the same number for every scene.
    pub fn context_views(&self) -> usize {
        self.scenes.values().next().map_or(0, |frames| frames.context.len())
    }

    /// Returns the frames of scene `key`, which has `count` frames.
    ///
    /// # Errors
    /// Fails if the index names a frame that the scene doesn't have.
    pub(super) fn frames(&self, key: &str, count: usize) -> Result<&SceneFrames> {
        let frames = &self.scenes[key];
        match frames.context.iter().chain(&frames.target).find(|&&frame| frame >= count) {
            None => Ok(frames),
            Some(frame) => {
                let expected = format!("one of the scene's {count}, 0 to {}", count.saturating_sub(1));
                Err(Error::input(&self.file, format!("a frame of scene {key}"), frame, expected))
            }
        }
    }
}

/// Number of target photos that are decoded together.
const DECODED_TOGETHER: usize = 2;

/// A scene: photos that a method may see, and photos that it has to match. The latter are decoded a few at a time, so that large photos don't
/// fill the memory all at once.
#[derive(Debug)]
pub struct EvalScene {
    /// Name of the capture, or key of the scene in an index.
    pub name: String,
    /// Context photos as the model sees them; empty if no model is evaluated.
    pub context: Vec<View>,
    /// Positions of the context and target photos in the capture.
    pub frames: SceneFrames,
    /// File names of the target images, without their extensions.
    pub render_names: Vec<String>,
    /// `true` if photos of the capture were enlarged to the size of the context or target views.
    pub enlarged: bool,
    capture: Capture,
    target_size: PhotoSize,
    /// Names of the target photos.
    target_names: Vec<String>,
    /// Depths of photos, at least two of which must cover a pixel that is scored; `None` to score all pixels.
    coverage: Option<Vec<DepthMap>>,
    /// Exact depths of all photos of the capture.
    depths: Option<ExactDepths>,
}

impl EvalScene {
    /// Creates a scene of the photos `frames` of `capture`. `context` has the context photos as the model sees them.
    pub(super) fn new(
        capture: &Capture,
        frames: SceneFrames,
        context: Vec<View>,
        target_size: PhotoSize,
    ) -> Self {
        let (names, render_names): (Vec<_>, _) = (capture.names().collect(), capture.render_names());
        let seen = context.first().map(size_of);
        let scored = if let PhotoSize::Exactly(size) = target_size { Some(size) } else { None };
        EvalScene {
            name: capture.name.clone(),
            enlarged: seen.into_iter().chain(scored).any(|size| capture.has_smaller(size)),
            target_names: frames.target.iter().map(|&photo| names[photo].to_string()).collect(),
            render_names: frames.target.iter().map(|&photo| render_names[photo].clone()).collect(),
            capture: capture.clone(),
            context,
            frames,
            target_size,
            coverage: None,
            depths: None,
        }
    }

    /// Restricts the scores to the pixels that the depths of at least two of the photos that `holdout` leaves cover: nothing can be known of
    /// the others.
    ///
    /// # Errors
    /// Fails if a photo can't be read.
    pub fn covered(self, holdout: Holdout) -> Result<Self> {
        let photo = |photo: usize| {
            let small = PhotoSize::Within(SWEEP_SIDE as u32).resized(&self.capture.camera(photo));
            Ok(load_views(&self.capture, &[photo], small)?.remove(0).to_small_photo(SWEEP_SIDE))
        };
        let photos = self.capture.split(holdout).0.into_iter().map(photo).collect::<Result<_>>()?;
        let depth_maps = sweep(photos, &read_points(&self.capture)?, |_| true).depth_maps;
        Ok(EvalScene { coverage: Some(depth_maps.into_iter().map(|(_, map)| map).collect()), ..self })
    }

    /// Scores all pixels, with the splat and the photos over the gray `level`, 0 for black to 255 for white.
    pub fn with_background(self, level: u8) -> Self {
        EvalScene { capture: self.capture.with_background(level), ..self }
    }

    /// Returns the gray level, 0 to 1, that splats and photos lie over.
    pub(super) fn background(&self) -> Option<f64> {
        self.capture.background().map(|level| f64::from(level) / 255.)
    }

    /// Adds the scores of depths by the exact ones in `file`, an array [photos, rows, columns] as `globalsplat synth --depth` writes it.
    ///
    /// # Errors
    /// Fails if the file can't be read, or if its shape isn't that of the capture's photos.
    pub fn with_depths(self, file: &Path) -> Result<Self> {
        let depths = ExactDepths::read(file, &self.capture)?;
        Ok(EvalScene { depths: Some(depths), ..self })
    }

    /// Returns the error of the rendered `depth` [H, W] of target view `i` ([`Scores::depth_error`](crate::metrics::Scores)), if exact
    /// depths are known at its size.
    pub(super) fn depth_error(&self, i: usize, view: &View, depth: &Tensor) -> Option<f64> {
        let exact = self.depths.as_ref()?.of_photo(self.frames.target[i]);
        (exact.size() == depth.size()).then(|| depth_error(depth, &exact, view.mask.as_ref()))
    }

    /// Creates a scene for splats and images, whose targets have the given size. They are the views that `holdout` holds out; without it,
    /// those of the capture's own test part, or all views if it has none.
    ///
    /// # Errors
    /// Fails if `holdout` holds nothing out, or leaves fewer than two views.
    pub fn without_context(capture: &Capture, holdout: Option<Holdout>, size: PhotoSize) -> Result<Self> {
        let target = match holdout {
            Some(holdout) => split_views(capture, holdout)?.target,
            None => capture.scored_views(),
        };
        Ok(EvalScene::new(capture, SceneFrames { context: vec![], target }, vec![], size))
    }

    /// Creates a scene for a model. The context consists of the photos that `holdout` leaves, or of `views` of them, spread over the
    /// camera's path, and is fitted to `photo_size`. The targets are the held-out photos, fitted to `target_size`.
    ///
    /// # Errors
    /// Fails if nothing is held out, if fewer than two photos are left, or if photos can't be read.
    pub fn held_out(
        capture: &Capture,
        holdout: Holdout,
        views: Option<usize>,
        photo_size: ImageSize,
        target_size: ImageSize,
    ) -> Result<Self> {
        let SceneFrames { target, .. } = split_views(capture, holdout)?;
        let photos = load_context(capture, holdout, views, photo_size)?;
        let frames = SceneFrames { context: context_views(capture, holdout, views), target };
        Ok(EvalScene::new(capture, frames, photos, PhotoSize::Exactly(target_size)))
    }

    /// Creates the scene of the frames of `key` in `index`, with context photos of `photo_size` if a model is evaluated. The target images
    /// are named by frame numbers.
    pub(super) fn indexed(
        key: &str,
        capture: &Capture,
        index: &EvaluationIndex,
        photo_size: Option<ImageSize>,
        target_size: ImageSize,
    ) -> Result<Self> {
        if !capture.is_complete() {
            let expected = "all that it names, as an index counts them";
            return Err(Error::input(capture.file(), "the photos", "not all there", expected));
        }
        let frames = index.frames(key, capture.len())?.clone();
        let context = match photo_size {
            Some(size) => load_views(capture, &frames.context, Some(size))?,
            None => vec![],
        };
        let names = frames.render_names();
        let scene = EvalScene::new(capture, frames, context, PhotoSize::Exactly(target_size));
        Ok(EvalScene { name: key.into(), target_names: names.clone(), render_names: names, ..scene })
    }

    /// Calls `visit` with the number of every target photo and the photo.
    ///
    /// # Errors
    /// Fails if a photo can't be read or `visit` fails.
    pub(super) fn for_each_target(&self, mut visit: impl FnMut(usize, &View) -> Result<()>) -> Result<()> {
        let mut numbers = 0..;
        let of_one_size = self.frames.target.chunk_by(|&a, &b| self.scored_size(a) == self.scored_size(b));
        for photos in of_one_size.flat_map(|photos| photos.chunks(DECODED_TOGETHER)) {
            let views = load_views(&self.capture, photos, self.scored_size(photos[0]))?;
            // In this order, the end of `views` takes no number.
            for (view, i) in views.into_iter().zip(&mut numbers) {
                let mut view = View { name: self.target_names[i].clone(), ..view };
                if let Some(depth_maps) = &self.coverage {
                    let mask = view.mask_or_ones().to_float() * covered(depth_maps, &view.camera);
                    view.mask = Some(mask.into());
                }
                visit(i, &view)?;
            }
        }
        Ok(())
    }

    /// Returns the size at which a photo of the capture is scored; `None` if it is its own.
    fn scored_size(&self, photo: usize) -> Option<ImageSize> {
        self.target_size.resized(&self.capture.camera(photo))
    }

    /// Returns the poses of the target photos, camera-to-world.
    pub(super) fn target_poses(&self) -> Vec<DMat4> {
        self.frames.target.iter().map(|&photo| self.capture.camera(photo).c2w).collect()
    }

    /// Scores a baseline that only copies photos: for every target, the context photo whose camera center is nearest.
    ///
    /// # Errors
    /// Fails if a photo can't be read.
    pub fn score_nearest_photo(&self) -> Result<CaptureScores> {
        self.score_baseline(|target| self.nearest_photo(target))
    }

    /// Returns the context photo whose camera center is nearest to that of `target`, at the size of the targets, `[3, H, W]`.
    pub(super) fn nearest_photo(&self, target: &View) -> Result<Tensor> {
        let center = |camera: Camera| camera.c2w.w_axis.truncate();
        let distance = |&of: &usize| {
            center(self.capture.camera(self.frames.context[of])).distance(center(target.camera))
        };
        let nearest = (0..self.context.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
        self.context_image(nearest.expect("a context view"))
    }

    /// Scores a baseline that shows the mean of all context photos at every target.
    ///
    /// # Errors
    /// Fails if a photo can't be read.
    pub fn score_mean_photo(&self) -> Result<CaptureScores> {
        let mut sum = self.context_image(0)?.copy();
        for i in 1..self.context.len() {
            sum += self.context_image(i)?;
        }
        let mean = sum / self.context.len() as f64;
        self.score_baseline(|_| Ok(mean.shallow_clone()))
    }

    /// Scores the images that `image` returns for the targets.
    fn score_baseline(&self, image: impl Fn(&View) -> Result<Tensor>) -> Result<CaptureScores> {
        let mut scores = vec![];
        self.for_each_target(|_, view| {
            if !view.is_masked_out() {
                scores.push(score_view(&image(view)?, view, None)?);
            }
            Ok(())
        })?;
        Ok(CaptureScores::from_views(&self.name, scores, None))
    }

    /// Returns context photo number `i` at the size of the targets, `[3, H, W]`.
    fn context_image(&self, i: usize) -> Result<Tensor> {
        match PhotoSize::Exactly(size_of(&self.context[i])) == self.target_size {
            true => Ok(self.context[i].image.to_float()),
            false => {
                let photo = self.frames.context[i];
                let views = load_views(&self.capture, &[photo], self.scored_size(photo))?;
                Ok(views[0].image.to_float())
            }
        }
    }
}

fn size_of(view: &View) -> ImageSize {
    ImageSize { height: view.camera.height, width: view.camera.width }
}

/// Returns the views that `holdout` leaves as context, and those that it holds out as targets.
pub(super) fn split_views(capture: &Capture, holdout: Holdout) -> Result<SceneFrames> {
    let (context, target) = capture.split(holdout);
    if target.is_empty() || context.len() < 2 {
        let split = format!("{} context and {} target views", context.len(), target.len());
        let expected = "2 and 1 at least (--holdout or data.holdout, every:N)";
        return Err(Error::input(capture.file(), format!("the split by {holdout}"), split, expected));
    }
    Ok(SceneFrames { context, target })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::ImageSource;
    use crate::scene::{Camera, Intrinsics};
    use glam::DVec3;
    use image::{Rgb, RgbImage};
    use std::sync::Arc;

    /// Images of 16×16 pixels of these gray levels.
    #[derive(Debug)]
    struct Grays([u8; 3]);

    impl ImageSource for Grays {
        fn name(&self) -> &str {
            "grays"
        }

        fn image(&self, index: usize) -> RgbImage {
            RgbImage::from_pixel(16, 16, Rgb([self.0[index]; 3]))
        }

        fn depth(&self, _: usize) -> Option<Vec<f32>> {
            None
        }
    }

    #[test]
    fn baselines_are_the_nearest_photo_and_the_mean() {
        let intrinsics = Intrinsics { fx: 16., fy: 16., cx: 8., cy: 8. };
        let camera =
            |x: f64| Camera { intrinsics, c2w: DMat4::from_translation(DVec3::X * x), width: 16, height: 16 };
        let cameras = [0., 1., 0.7].map(camera);
        let source = Arc::new(Grays([51, 153, 178]));
        let capture = Capture::from_source("grays".into(), "grays".into(), &cameras, source).unwrap();
        let frames = SceneFrames { context: vec![0, 1], target: vec![2] };
        for photo_size in [[16, 16], [8, 8]] {
            let context = load_views(&capture, &frames.context, Some(photo_size.into())).unwrap();
            let size = PhotoSize::Exactly([16, 16].into());
            let scene = EvalScene::new(&capture, frames.clone(), context, size);
            for (scores, levels) in
                [(scene.score_nearest_photo(), 178. - 153.), (scene.score_mean_photo(), 178. - 102.)]
            {
                let expected = 20. * (255f64 / levels).log10();
                assert!((scores.unwrap().mean.psnr - expected).abs() < 1e-4, "{expected}");
            }
        }
    }

    fn read(text: &str) -> Result<EvaluationIndex> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        EvaluationIndex::read(file.path())
    }

    #[test]
    fn null_scenes_are_left_out() {
        let index = read(r#"{"b": null, "a": {"context": [3, 0], "target": [1], "overlap": 0.5}}"#).unwrap();
        assert_eq!(index.scenes.keys().collect::<Vec<_>>(), ["a"]);
        assert_eq!(index.frames("a", 4).unwrap().context, [3, 0]);
        let error = index.frames("a", 3).unwrap_err().to_string();
        assert!(error.contains("a frame of scene a is 3, expected one of the scene's 3, 0 to 2"), "{error}");
    }

    #[test]
    fn malformed_indices_are_refused() {
        for (text, found) in [
            ("{}", "one without scenes"),
            ("{\"a\": null}", "one without scenes"),
            ("[1]", "unusable"),
            ("{\"a\": {\"context\": [1, -2], \"target\": [1]}}", "unusable"),
            ("{\"a\": {\"context\": [1, 2.5], \"target\": [1]}}", "unusable"),
            ("{\"a\": {\"context\": [1, 2]}}", "missing field `target`"),
            ("{\"a\": {\"context\": [1], \"target\": [1]}}", "scene a is 1 context and 1 target frames"),
            ("{\"a\": {\"context\": [1, 2], \"target\": []}}", "scene a is 2 context and 0 target frames"),
        ] {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains(found), "{error}");
        }
    }
}
