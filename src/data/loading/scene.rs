//! Scenes as passed from the loader threads to the training thread.

use crate::scene::{Camera, ImageSize};
use std::ops::AddAssign;
use tch::Tensor;

/// Time in seconds that a thread spent on each part of loading.
#[derive(Debug, Clone, Copy, Default)]
pub struct LoadTimes {
    /// Time for reading files that hold several scenes, or for waiting until another thread has read them.
    pub read: f64,
    /// Time for decoding photos, including reading them if each photo is a file of its own.
    pub decode: f64,
    /// Time for cropping, resizing and mirroring.
    pub resize: f64,
    /// Time for color jitter.
    pub augment: f64,
    /// Time for the search of depths.
    pub depths: f64,
}

impl AddAssign for LoadTimes {
    fn add_assign(&mut self, other: Self) {
        self.read += other.read;
        self.decode += other.decode;
        self.resize += other.resize;
        self.augment += other.augment;
        self.depths += other.depths;
    }
}

/// A scene of a training sample: N photos, each of them context, target or both.
#[derive(Debug, Clone)]
pub struct LoadedScene {
    /// Name of the capture.
    pub name: String,
    /// 8-bit pixels, `[N, 3, H, W]`.
    pub images: Vec<u8>,
    /// 8-bit weights of the pixels, `[N, H, W]`: 255 where a pixel counts, 0 where it is masked out. `None` if every pixel counts.
    pub masks: Option<Vec<u8>>,
    /// Depths of the context images, `[C, 2, H, W]`: inverse depth in normalized world coordinates, and how sure it is. `None` if
    /// the model reads none.
    pub depths: Option<Vec<f32>>,
    /// Size of all images.
    pub size: ImageSize,
    /// Cameras of the images, in normalized world coordinates.
    pub cameras: Vec<Camera>,
    /// Indices of the context images, ascending.
    pub context: Vec<usize>,
    /// Indices of the target images, which renderings are compared with, ascending.
    pub target: Vec<usize>,
    /// Far plane of the frusta in normalized world coordinates.
    pub far: f64,
    /// Time spent on loading the scene.
    pub times: LoadTimes,
}

impl LoadedScene {
    /// Returns the depths as a tensor, `[C, 2, H, W]`.
    pub(super) fn depth_tensor(&self) -> Option<Tensor> {
        let [height, width] = [self.size.height, self.size.width].map(i64::from);
        self.depths.as_ref().map(|depths| Tensor::from_slice(depths).view([-1, 2, height, width]))
    }
}
