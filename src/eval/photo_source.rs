//! Photos that are loaded one at a time.

use crate::data::{Capture, PhotoSize, View, load_views};
use crate::error::Result;
use glam::DMat4;

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
