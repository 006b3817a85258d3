//! The loader: how many views a second reach training as tensors, and where the time goes.

use super::video::write_videos;
use crate::data::{DataConfig, LoadTimes, Loader, Sample, SceneGroups};
use crate::error::Result;
use crate::eval::{peak_memory_bytes, resident_memory_bytes};
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;
use tch::Device;

/// Samples that aren't measured: they fill queues, caches and the allocator's pools.
const WARM_UP: u64 = 16;

/// Videos of the made-up data, frames of each, and megabytes of a chunk: two videos.
const VIDEOS: usize = 8;
const FRAMES: usize = 150;
const CHUNK_BYTES: usize = 14_000_000;

/// What [`bench_loader`] measured.
#[derive(Debug, Serialize)]
pub struct LoaderReport {
    /// That load.
    pub threads: usize,
    /// Scenes that were delivered.
    pub samples: u64,
    /// Images that were delivered; one that is both context and target counts twice.
    pub views: u64,
    /// Images that were decoded for it.
    pub photos: u64,
    /// [height, width] of a view.
    pub size: [u32; 2],
    /// Scenes a second.
    pub samples_per_second: f64,
    /// Views a second.
    pub views_per_second: f64,
    /// Milliseconds of a thread per decoded photo.
    pub milliseconds: StageMilliseconds,
    /// Resident memory after each tenth of the samples, in bytes: the first holds what a run holds, the last no more.
    pub resident_by_tenth: Vec<u64>,
    /// Resident bytes at the most.
    pub resident_peak: u64,
}

/// Where time goes, in milliseconds per decoded photo.
#[derive(Debug, Serialize)]
pub struct StageMilliseconds {
    /// Reading chunks.
    pub read: f64,
    /// JPEG to pixels.
    pub decode: f64,
    /// Crop and resize.
    pub resize: f64,
    /// Colours.
    pub augment: f64,
    /// Bytes to float tensors, in the thread that trains.
    pub to_tensor: f64,
}

/// Writes the made-up data at `root`: chunks of 640×360 video.
///
/// # Errors
/// The system's refusal to write.
pub fn made_up_videos(root: &Path) -> Result<()> {
    write_videos(root, VIDEOS, FRAMES, CHUNK_BYTES)
}

/// Loads `samples` samples of `scenes` and makes tensors of them, one sample after the other.
///
/// # Errors
/// What [`Loader`] fails with.
pub fn bench_loader(config: &DataConfig, scenes: Arc<dyn SceneGroups>, samples: u64) -> Result<LoaderReport> {
    let mut loader = Loader::start(config, 0, scenes, 1, 0)?;
    let next = |loader: &mut Loader| -> Result<(u64, u64, LoadTimes, f64)> {
        let scene = loader.next_scene()?;
        let start = Instant::now();
        let views = (scene.context.len() + scene.target.len()) as u64;
        let (photos, times) = (scene.cameras.len() as u64, scene.times);
        drop(Sample::of(&[scene], Device::Cpu));
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
