//! Scenes for evaluation: context photos, which a method may see, and target photos, which it has to match, as an index or a holdout
//! splits them.

use crate::data::{Capture, Holdout, PhotoSize, View, load_views};
use crate::error::{Error, Result};
use crate::io::{read_text, write_json};
use crate::metrics::{CaptureScores, score_view};
use crate::reconstruct::{context_views, load_context};
use crate::scene::ImageSize;
use glam::DMat4;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

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
        Ok(write_json(&self.file, &self.scenes)?)
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

/// A scene: photos that a method may see, and photos that it has to match. The latter are decoded one at a time, so that large photos don't
/// fill the memory all at once.
#[derive(Debug)]
pub struct EvalScene {
    /// Name of the capture, or key of the scene in an index.
    pub name: String,
    /// Context photos, which the model sees; empty if no model is evaluated.
    pub context: Vec<View>,
    /// Positions of the context and target photos in the capture.
    pub frames: SceneFrames,
    /// File names of the target images, without their extensions.
    pub render_names: Vec<String>,
    capture: Capture,
    target_size: PhotoSize,
    /// Names of the target photos.
    target_names: Vec<String>,
}

impl EvalScene {
    /// Creates a scene from the photos `frames` of `capture`. `context` has the context photos as the model sees them.
    pub(super) fn new(
        capture: &Capture,
        frames: SceneFrames,
        context: Vec<View>,
        target_size: PhotoSize,
    ) -> Self {
        let (names, render_names): (Vec<_>, _) = (capture.names().collect(), capture.render_names());
        EvalScene {
            name: capture.name.clone(),
            target_names: frames.target.iter().map(|&photo| names[photo].to_string()).collect(),
            render_names: frames.target.iter().map(|&photo| render_names[photo].clone()).collect(),
            capture: capture.clone(),
            context,
            frames,
            target_size,
        }
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
    /// camera's path, and is fitted to `photo_size`. The targets are the held-out photos, of `target_size`.
    ///
    /// # Errors
    /// Fails if nothing is held out, if fewer than two photos are left, or if photos can't be read.
    pub fn held_out(
        capture: &Capture,
        holdout: Holdout,
        views: Option<usize>,
        photo_size: ImageSize,
        target_size: PhotoSize,
    ) -> Result<Self> {
        let SceneFrames { target, .. } = split_views(capture, holdout)?;
        let photos = load_context(capture, holdout, views, photo_size)?;
        let context = context_views(capture, holdout, views);
        Ok(EvalScene::new(capture, SceneFrames { context, target }, photos, target_size))
    }

    /// Creates the scene from the frames of `key` in `index`, with context photos of `photo_size` if a model is evaluated. The target images
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
        // Chunks name frames by six-digit numbers.
        let names: Vec<_> = frames.target.iter().map(|frame| format!("{frame:06}")).collect();
        let scene = EvalScene::new(capture, frames, context, PhotoSize::Exactly(target_size));
        Ok(EvalScene { name: key.into(), target_names: names.clone(), render_names: names, ..scene })
    }

    /// Loads target photo number `i`.
    pub(super) fn load_target(&self, i: usize) -> Result<View> {
        let photo = self.frames.target[i];
        let size = self.target_size.resized(&self.capture.camera(photo));
        let view = load_views(&self.capture, &[photo], size)?.remove(0);
        Ok(View { name: self.target_names[i].clone(), ..view })
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
        let center = |photo: usize| self.capture.camera(photo).c2w.w_axis.truncate();
        let mut scores = vec![];
        for (i, &target) in self.frames.target.iter().enumerate() {
            let distance = |photo: &usize| center(*photo).distance(center(target));
            let nearest = self.frames.context.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
            let view = self.load_target(i)?;
            if !view.is_masked_out() {
                let nearest = *nearest.expect("a context view");
                let photo = load_views(&self.capture, &[nearest], Some(size_of(&view)))?.remove(0);
                scores.push(score_view(&photo.image.to_float(), &view, None)?);
            }
        }
        Ok(CaptureScores::from_views(&self.name, scores, None))
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
