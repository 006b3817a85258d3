//! Photos that are needed one after the other.

use crate::data::{Capture, View};
use crate::error::Result;
use crate::scene::ImageSize;
use glam::DMat4;

/// Photos of a capture. They are decoded when they are asked for, so that large ones don't fill the memory all at once.
#[derive(Debug)]
pub enum PhotoSource {
    /// Photos in memory.
    Loaded(Vec<View>),
    /// Photos in their files.
    OnDisk {
        /// The capture that they are of.
        capture: Capture,
        /// Their positions in it.
        indices: Vec<usize>,
        /// What they are called.
        names: Vec<String>,
        /// The size that they are fitted to; without one they are loaded as they are.
        size: Option<ImageSize>,
    },
}

impl PhotoSource {
    /// Returns the photos of `indices`, by their names in `capture`, fitted to `size`.
    pub fn of(capture: &Capture, indices: &[usize], size: Option<ImageSize>) -> Self {
        let all: Vec<&str> = capture.names().collect();
        let names = indices.iter().map(|&index| all[index].to_string()).collect();
        PhotoSource::OnDisk { capture: capture.clone(), indices: indices.to_vec(), names, size }
    }

    /// Returns the number of photos.
    pub fn len(&self) -> usize {
        match self {
            PhotoSource::Loaded(views) => views.len(),
            PhotoSource::OnDisk { indices, .. } => indices.len(),
        }
    }

    /// Returns whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the poses of the photos, camera-to-world, which need no pixels.
    pub fn poses(&self) -> Vec<DMat4> {
        match self {
            PhotoSource::Loaded(views) => views.iter().map(|view| view.camera.c2w).collect(),
            PhotoSource::OnDisk { capture, indices, .. } => {
                let cameras = capture.cameras();
                indices.iter().map(|&index| cameras[index].c2w).collect()
            }
        }
    }

    /// Loads photo `i` of them.
    ///
    /// # Errors
    /// A photo that can't be read.
    pub fn load(&self, i: usize) -> Result<View> {
        match self {
            PhotoSource::Loaded(views) => Ok(views[i].shallow_clone()),
            PhotoSource::OnDisk { capture, indices, names, size } => {
                let view = capture.load(&indices[i..=i], *size)?.remove(0);
                Ok(View { name: names[i].clone(), ..view })
            }
        }
    }
}
