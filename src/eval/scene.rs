//! Scenes for evaluation: context photos, which a method may see, and target photos, which it has to match, as an index or a holdout
//! splits them.

use crate::data::{Capture, Holdout, PhotoSize, SceneGroup, View, load_views};
use crate::error::{Error, Result};
use crate::io::{read_text, write_json};
use crate::reconstruct::load_context;
use crate::scene::ImageSize;
use glam::DMat4;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::mpsc::SyncSender;

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
        Ok(capture.checksum(self.context.iter().chain(&self.target).copied())?)
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

/// Photos of a capture. They are decoded on access, so that large photos don't fill the memory all at once.
#[derive(Debug)]
pub enum LazyPhotos {
    /// Photos in memory.
    Loaded(Vec<View>),
    /// Photos in their files.
    OnDisk {
        /// Capture that holds the photos.
        capture: Capture,
        /// Positions of the photos in the capture.
        indices: Vec<usize>,
        /// Names of the photos.
        names: Vec<String>,
        /// Size of the photos.
        size: PhotoSize,
    },
}

impl LazyPhotos {
    /// Creates a source of the photos `indices` of `capture`, under their names in the capture, at `size`.
    pub fn from_capture(capture: &Capture, indices: &[usize], size: PhotoSize) -> Self {
        let all: Vec<&str> = capture.names().collect();
        let names = indices.iter().map(|&index| all[index].to_string()).collect();
        LazyPhotos::OnDisk { capture: capture.clone(), indices: indices.to_vec(), names, size }
    }

    /// Returns the number of photos.
    pub fn len(&self) -> usize {
        match self {
            LazyPhotos::Loaded(views) => views.len(),
            LazyPhotos::OnDisk { indices, .. } => indices.len(),
        }
    }

    /// Returns `true` if there are no photos.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the poses of the photos, camera-to-world, without loading pixels.
    pub fn poses(&self) -> Vec<DMat4> {
        match self {
            LazyPhotos::Loaded(views) => views.iter().map(|view| view.camera.c2w).collect(),
            LazyPhotos::OnDisk { capture, indices, .. } => {
                let cameras = capture.cameras();
                indices.iter().map(|&index| cameras[index].c2w).collect()
            }
        }
    }

    /// Loads photo number `i`.
    ///
    /// # Errors
    /// Fails if the photo can't be read.
    pub fn load(&self, i: usize) -> Result<View> {
        match self {
            LazyPhotos::Loaded(views) => Ok(views[i].shallow_clone()),
            LazyPhotos::OnDisk { capture, indices, names, size } => {
                let size = size.resized(&capture.camera(indices[i]));
                let view = load_views(capture, &indices[i..=i], size)?.remove(0);
                Ok(View { name: names[i].clone(), ..view })
            }
        }
    }
}

/// A scene, with the context photos in memory.
#[derive(Debug)]
pub struct EvalScene {
    /// Name of the capture, or key of the scene in an index.
    pub name: String,
    /// Context photos, which the model sees; empty if no model is evaluated.
    pub context: Vec<View>,
    /// Target photos, loaded one by one.
    pub target: LazyPhotos,
    /// File names of the target images, without their extensions.
    pub render_names: Vec<String>,
    /// Positions of the context and target photos in the capture; `None` without an index.
    pub frames: Option<SceneFrames>,
    /// Checksum of the photos and cameras that the index names; 0 without an index.
    pub(super) checksum: u32,
    /// `true` if photos of the capture were enlarged to the size of the context or target views.
    pub enlarged: bool,
}

impl EvalScene {
    /// Creates a scene for splats and images, whose targets have the given size. They are the views that `holdout` holds out; without it,
    /// those of the capture's own test part, or all views if it has none.
    ///
    /// # Errors
    /// Fails if `holdout` holds nothing out, or leaves fewer than two views.
    pub fn without_context(capture: &Capture, holdout: Option<Holdout>, size: PhotoSize) -> Result<Self> {
        let views = match holdout {
            Some(holdout) => split_views(capture, holdout)?.1,
            None => capture.scored_views(),
        };
        let names = capture.render_names();
        Ok(EvalScene {
            name: capture.name.clone(),
            context: vec![],
            target: LazyPhotos::from_capture(capture, &views, size),
            render_names: views.into_iter().map(|view| names[view].clone()).collect(),
            frames: None,
            checksum: 0,
            enlarged: matches!(size, PhotoSize::Exactly(size) if capture.has_smaller(size)),
        })
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
        let (_, held_out) = split_views(capture, holdout)?;
        let all = capture.render_names();
        Ok(EvalScene {
            name: capture.name.clone(),
            context: load_context(capture, holdout, views, photo_size)?,
            target: LazyPhotos::from_capture(capture, &held_out, PhotoSize::Exactly(target_size)),
            render_names: held_out.iter().map(|&view| all[view].clone()).collect(),
            frames: None,
            checksum: 0,
            enlarged: [photo_size, target_size].into_iter().any(|size| capture.has_smaller(size)),
        })
    }

    /// Creates the scene from the frames of `key` in the loader's index. The target images are named by frame numbers.
    fn indexed(key: &str, capture: &Capture, loader: &SceneLoader) -> Result<Self> {
        if !capture.is_complete() {
            let expected = "all that it names, as an index counts them";
            return Err(Error::input(capture.file(), "the photos", "not all there", expected));
        }
        let frames = loader.index.frames(key, capture.len())?.clone();
        let context = match loader.photo_size {
            Some(size) => load_views(capture, &frames.context, Some(size))?,
            None => vec![],
        };
        let render_names = frames.render_names();
        let target = LazyPhotos::OnDisk {
            capture: capture.clone(),
            indices: frames.target.clone(),
            names: render_names.clone(),
            size: PhotoSize::Exactly(loader.target_size),
        };
        let mut sizes = loader.photo_size.into_iter().chain([loader.target_size]);
        let enlarged = sizes.any(|size| capture.has_smaller(size));
        let checksum = frames.checksum(capture)?;
        Ok(EvalScene {
            name: key.into(),
            context,
            target,
            render_names,
            frames: Some(frames),
            checksum,
            enlarged,
        })
    }
}

/// Returns the positions of the views that `holdout` leaves, and of those that it holds out.
pub(super) fn split_views(capture: &Capture, holdout: Holdout) -> Result<(Vec<usize>, Vec<usize>)> {
    let (context, held_out) = capture.split(holdout);
    if held_out.is_empty() || context.len() < 2 {
        let split = format!("{} context and {} target views", context.len(), held_out.len());
        let expected = "2 and 1 at least (--holdout or data.holdout, every:N)";
        return Err(Error::input(capture.file(), format!("the split by {holdout}"), split, expected));
    }
    Ok((context, held_out))
}

/// Loader of the scenes of an index. It runs on another thread than the evaluation.
pub(super) struct SceneLoader<'a> {
    pub index: &'a EvaluationIndex,
    /// Size of the target views.
    pub target_size: ImageSize,
    /// Size of the context views; `None` if no model is evaluated.
    pub photo_size: Option<ImageSize>,
}

impl SceneLoader<'_> {
    /// Sends the scenes of `groups` one by one until the receiver is dropped. Each chunk is read once.
    pub fn send(
        &self,
        groups: Vec<(&SceneGroup, Vec<String>)>,
        sender: &SyncSender<(String, Result<EvalScene>)>,
    ) {
        for (group, keys) in groups.into_iter().filter(|(_, keys)| !keys.is_empty()) {
            let open = group.open().map_err(|e| e.to_string());
            for key in keys {
                let scene = match &open {
                    Ok(open) => {
                        open.capture(&key).and_then(|capture| EvalScene::indexed(&key, &capture, self))
                    }
                    Err(e) => Err(Error::failed(e.clone())),
                };
                if sender.send((key, scene)).is_err() {
                    return;
                }
            }
        }
    }
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
