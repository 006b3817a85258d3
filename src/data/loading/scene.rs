//! A scene on its way from the threads that load to the one that trains.

use crate::scene::{Camera, ImageSize};
use std::ops::AddAssign;

/// Seconds that a thread spent.
#[derive(Debug, Clone, Copy, Default)]
pub struct LoadTimes {
    /// Reading files that hold several scenes, or waiting until another thread has.
    pub read: f64,
    /// Making pixels of encoded photos; where a photo is a file of its own, with reading it.
    pub decode: f64,
    /// Cropping, resizing and mirroring.
    pub resize: f64,
    /// Changing colours.
    pub augment: f64,
}

impl AddAssign for LoadTimes {
    fn add_assign(&mut self, other: Self) {
        self.read += other.read;
        self.decode += other.decode;
        self.resize += other.resize;
        self.augment += other.augment;
    }
}

/// A scene of a training sample: N photos, each of them context, target or both.
#[derive(Debug, Clone)]
pub struct LoadedScene {
    /// The capture's.
    pub name: String,
    /// [N, 3, H, W].
    pub images: Vec<u8>,
    /// Of all images.
    pub size: ImageSize,
    /// Of the images, in the normalized world.
    pub cameras: Vec<Camera>,
    /// Which images the model sees, ascending.
    pub context: Vec<usize>,
    /// Which images its pictures are compared with, ascending.
    pub target: Vec<usize>,
    /// Far end of the frusta in the normalized world.
    pub far: f64,
    /// What it took.
    pub times: LoadTimes,
}
