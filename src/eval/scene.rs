//! What a method is judged by: photos that it may see, and photos that it has to match.

use super::index::{EvaluationIndex, SceneFrames};
use super::photo_source::PhotoSource;
use crate::data::{Capture, Holdout, SceneGroup, View};
use crate::error::{Error, Result};
use crate::reconstruct::load_context;
use crate::scene::ImageSize;
use std::sync::mpsc::SyncSender;

/// A scene, with the photos that a model is shown in memory.
#[derive(Debug)]
pub struct EvalScene {
    /// The capture's, or the key in an index.
    pub name: String,
    /// The photos that a model is shown; none where no model is judged.
    pub context: Vec<View>,
    /// What has to be matched, loaded one by one.
    pub target: PhotoSource,
    /// What pictures of the targets are called, without their ending.
    pub picture_names: Vec<String>,
    /// Their positions in the capture, where an index tells them.
    pub frames: Option<SceneFrames>,
    /// A checksum of the photos and cameras that an index tells; 0 without one.
    pub(super) checksum: u32,
    /// Whether photos of the capture were enlarged, to be shown or to be matched.
    pub enlarged: bool,
}

impl EvalScene {
    /// Every photo of `capture`, or of its own test part if it has one, fitted to `size` or as it is, for splats and pictures.
    pub fn all_views(capture: &Capture, size: Option<ImageSize>) -> Self {
        let (views, names) = (capture.scored_views(), capture.picture_names());
        EvalScene {
            name: capture.name.clone(),
            context: vec![],
            target: PhotoSource::of(capture, &views, size),
            picture_names: views.into_iter().map(|view| names[view].clone()).collect(),
            frames: None,
            checksum: 0,
            enlarged: size.is_some_and(|size| capture.has_smaller(size)),
        }
    }

    /// For a model: it is shown the photos that `holdout` leaves, or so many of them, spread over the camera's path, fitted to
    /// `photo_size`, and has to match the others at `picture_size`.
    ///
    /// # Errors
    /// Nothing held out, or photos that can't be read.
    pub fn held_out(
        capture: &Capture,
        holdout: Holdout,
        views: Option<usize>,
        photo_size: ImageSize,
        picture_size: ImageSize,
    ) -> Result<Self> {
        let (_, held_out) = split_views(capture, holdout)?;
        let all = capture.picture_names();
        Ok(EvalScene {
            name: capture.name.clone(),
            context: load_context(capture, holdout, views, photo_size)?,
            target: PhotoSource::of(capture, &held_out, Some(picture_size)),
            picture_names: held_out.iter().map(|&view| all[view].clone()).collect(),
            frames: None,
            checksum: 0,
            enlarged: [photo_size, picture_size].into_iter().any(|size| capture.has_smaller(size)),
        })
    }

    /// The frames of scene `key` in `index`, named by their numbers.
    fn indexed(key: &str, capture: &Capture, loader: &SceneLoader) -> Result<Self> {
        if !capture.is_complete() {
            let expected = "all that it names, as an index counts them";
            return Err(Error::input(capture.file(), "the photos", "not all there", expected));
        }
        let frames = loader.index.frames(key, capture.len())?.clone();
        let context = match loader.photo_size {
            Some(size) => capture.load(&frames.context, Some(size))?,
            None => vec![],
        };
        let picture_names = frames.picture_names();
        let target = PhotoSource::OnDisk {
            capture: capture.clone(),
            indices: frames.target.clone(),
            names: picture_names.clone(),
            size: Some(loader.picture_size),
        };
        let mut sizes = loader.photo_size.into_iter().chain([loader.picture_size]);
        let enlarged = sizes.any(|size| capture.has_smaller(size));
        let checksum = frames.checksum(capture)?;
        Ok(EvalScene {
            name: key.into(),
            context,
            target,
            picture_names,
            frames: Some(frames),
            checksum,
            enlarged,
        })
    }
}

/// Positions of the views that `holdout` leaves, and of those that it holds out.
pub(super) fn split_views(capture: &Capture, holdout: Holdout) -> Result<(Vec<usize>, Vec<usize>)> {
    let (context, held_out) = capture.split(holdout);
    if held_out.is_empty() || context.len() < 2 {
        let split = format!("{} context and {} target views", context.len(), held_out.len());
        let expected = "2 and 1 at least (--holdout or data.holdout, every:N)";
        return Err(Error::input(capture.file(), format!("the split by {holdout}"), split, expected));
    }
    Ok((context, held_out))
}

/// Reads the scenes of an index, beside the thread that judges them.
pub(super) struct SceneLoader<'a> {
    pub index: &'a EvaluationIndex,
    /// Of the targets.
    pub picture_size: ImageSize,
    /// Of the context, which only a model looks at.
    pub photo_size: Option<ImageSize>,
}

impl SceneLoader<'_> {
    /// Sends the scenes of `groups` one by one, each chunk read once, until nobody listens.
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
                    Err(e) => Err(Error::Failed(e.clone())),
                };
                if sender.send((key, scene)).is_err() {
                    return;
                }
            }
        }
    }
}
