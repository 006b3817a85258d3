//! Made-up videos: how many views a second one core makes.

use crate::scene::ImageSize;
use crate::synth::{Video, VideoSettings};
use serde::Serialize;
use std::time::Instant;

/// What [`bench_synth`] measured.
#[derive(Debug, Serialize)]
pub struct SynthReport {
    /// Worlds that were made.
    pub videos: u64,
    /// Views that were taken of them.
    pub views: usize,
    /// [height, width] of a view.
    pub size: [u32; 2],
    /// Rays from the eye a pixel; each asks a lamp by another one.
    pub rays_per_pixel: u32,
    /// Triangles of a world, the mean.
    pub triangles: usize,
    /// Views a second of one thread, worlds being there.
    pub views_per_second: f64,
    /// 10⁶ rays a second of one thread, shadows counted: two for each sample.
    pub megarays_per_second: f64,
    /// Seconds until a world can be looked at, on all threads.
    pub seconds_per_world: f64,
}

/// Makes `videos` worlds and takes `frames` views of each, of side `side`, on the calling thread.
pub fn bench_synth(videos: u64, frames: usize, side: u32, mut progress: impl FnMut()) -> SynthReport {
    let settings = VideoSettings { frames, size: ImageSize { height: side, width: side }, pictures: vec![] };
    let (mut making, mut taking, mut triangles) = (0., 0., 0);
    for index in 0..videos {
        let start = Instant::now();
        let video = Video::new(0, index, &settings);
        making += start.elapsed().as_secs_f64();
        let start = Instant::now();
        for frame in 0..frames {
            std::hint::black_box(video.photo(frame));
        }
        taking += start.elapsed().as_secs_f64();
        triangles += video.triangles();
        progress();
    }
    let views = videos as usize * frames;
    let samples = views as f64 * f64::from(side * side * Video::RAYS_PER_PIXEL);
    SynthReport {
        videos,
        views,
        size: settings.size.into(),
        rays_per_pixel: Video::RAYS_PER_PIXEL,
        triangles: triangles / videos as usize,
        views_per_second: views as f64 / taking,
        megarays_per_second: 2e-6 * samples / taking,
        seconds_per_world: making / videos as f64,
    }
}
