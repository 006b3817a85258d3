//! Benchmark of synthetic videos: views per second that one core renders.

use crate::scene::ImageSize;
use crate::synth::{Video, VideoSettings};
use serde::Serialize;
use std::time::Instant;

/// Results of [`bench_synth`].
#[derive(Debug, Serialize)]
pub struct SynthReport {
    /// Number of synthetic scenes.
    pub videos: u64,
    /// Number of views that were rendered.
    pub views: usize,
    /// Size of a view, `[height, width]`.
    pub size: [u32; 2],
    /// Camera rays per pixel. Each of them casts one shadow ray towards a lamp.
    pub rays_per_pixel: u32,
    /// Mean number of triangles per scene.
    pub triangles: usize,
    /// Views per second of one thread, without the time for building the scenes.
    pub views_per_second: f64,
    /// Rays per second of one thread, in 10⁶, including shadow rays: two rays per sample.
    pub megarays_per_second: f64,
    /// Time in seconds for building a scene, on all threads.
    pub seconds_per_world: f64,
}

/// Builds `videos` synthetic scenes, and renders `frames` square views of each with sides of `side` pixels on the calling thread.
/// `progress` is called after each scene.
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
