//! Benchmark of the data loader: views per second that arrive as tensors, and the time of each stage.

use super::video::write_videos;
use crate::data::{Batch, DataConfig, DataLoader, LoadTimes, SceneGroups};
use crate::device::{peak_memory_bytes, resident_memory_bytes};
use crate::error::Result;
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;
use tch::Device;

/// Number of samples before the measurement starts. They fill queues, caches and the allocator's pools.
const WARM_UP: u64 = 16;

/// Number of synthetic videos, of frames per video, and of bytes per chunk, which holds about two videos.
const VIDEOS: usize = 8;
const FRAMES: usize = 150;
const CHUNK_BYTES: usize = 14_000_000;

/// Results of [`bench_loader`].
#[derive(Debug, Serialize)]
pub struct LoaderReport {
    /// Number of loader threads.
    pub threads: usize,
    /// Number of scenes that were loaded.
    pub samples: u64,
    /// Number of images that were loaded. An image that is both context and target counts twice.
    pub views: u64,
    /// Number of photos that were decoded.
    pub photos: u64,
    /// Size of a view, `[height, width]`.
    pub size: [u32; 2],
    /// Scenes per second.
    pub samples_per_second: f64,
    /// Views per second.
    pub views_per_second: f64,
    /// Time of each stage in one thread per decoded photo, in milliseconds.
    pub milliseconds: StageMilliseconds,
    /// Resident memory after each tenth of the samples, in bytes. The first value already includes everything that a run needs, so later
    /// values should be no larger.
    pub resident_by_tenth: Vec<u64>,
    /// Peak resident memory, in bytes.
    pub resident_peak: u64,
}

/// Time of each stage, in milliseconds per decoded photo.
#[derive(Debug, Serialize)]
pub struct StageMilliseconds {
    /// Time for reading chunks.
    pub read: f64,
    /// Time for decoding JPEGs.
    pub decode: f64,
    /// Time for cropping and resizing.
    pub resize: f64,
    /// Time for colour augmentation.
    pub augment: f64,
    /// Time for converting bytes to float tensors, in the training thread.
    pub to_tensor: f64,
}

/// Writes the synthetic dataset to `root`: chunks of 640×360 video.
///
/// # Errors
/// Fails if a file can't be written.
pub fn synthetic_videos(root: &Path) -> Result<()> {
    write_videos(root, VIDEOS, FRAMES, CHUNK_BYTES)
}

/// Loads `samples` samples of `scenes` one after the other, and converts them to tensors.
///
/// # Errors
/// Fails if the [`DataLoader`] fails.
pub fn bench_loader(config: &DataConfig, scenes: Arc<dyn SceneGroups>, samples: u64) -> Result<LoaderReport> {
    let mut loader = DataLoader::start(config, 0, scenes, 1, 0)?;
    let next = |loader: &mut DataLoader| -> Result<(u64, u64, LoadTimes, f64)> {
        let scene = loader.next_scene()?;
        let start = Instant::now();
        let views = (scene.context.len() + scene.target.len()) as u64;
        let (photos, times) = (scene.cameras.len() as u64, scene.times);
        drop(Batch::from_scenes(&[scene], Device::Cpu)?);
        Ok((views, photos, times, start.elapsed().as_secs_f64()))
    };
    for _ in 0..WARM_UP {
        next(&mut loader)?;
    }
    let (mut views, mut photos, mut times, mut to_tensor) = (0, 0, LoadTimes::default(), 0.);
    let mut resident_by_tenth = vec![];
    let start = Instant::now();
    for sample in 0..samples {
        let (its_views, its_photos, its_times, seconds) = next(&mut loader)?;
        (views, photos, to_tensor) = (views + its_views, photos + its_photos, to_tensor + seconds);
        times += its_times;
        if (sample + 1) * 10 / samples > sample * 10 / samples {
            resident_by_tenth.push(resident_memory_bytes());
        }
    }
    let seconds = start.elapsed().as_secs_f64();
    let per_photo = |seconds: f64| 1e3 * seconds / photos as f64;
    Ok(LoaderReport {
        threads: loader.threads(),
        samples,
        views,
        photos,
        size: config.image_size.into(),
        samples_per_second: samples as f64 / seconds,
        views_per_second: views as f64 / seconds,
        milliseconds: StageMilliseconds {
            read: per_photo(times.read),
            decode: per_photo(times.decode),
            resize: per_photo(times.resize),
            augment: per_photo(times.augment),
            to_tensor: per_photo(to_tensor),
        },
        resident_by_tenth,
        resident_peak: peak_memory_bytes(),
    })
}
