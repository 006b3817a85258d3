//! Scenes for evaluation: context photos, which a method may see, and target photos, which it has to match.

use super::index::{EvaluationIndex, SceneFrames};
use super::photo_source::LazyPhotos;
use crate::data::{Capture, Holdout, PhotoSize, SceneGroup, View, load_views};
use crate::error::{Error, Result};
use crate::reconstruct::load_context;
use crate::scene::ImageSize;
use std::sync::mpsc::SyncSender;

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
