//! Gaussians to begin with where nothing is known but photos, or photos and points.

use super::sweep::{Swept, sweep};
use crate::data::{Point, View};
use crate::scene::{RawGaussians, SH_C0};
use glam::DVec3;
use rand::seq::index::sample;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::{Kind, Tensor};

/// Standard deviation, in units of the distance between neighbours.
const EXTENT: f64 = 0.5;
/// Of the opacity.
const LOGIT: f32 = -1.;
/// Of all Gaussians, those that lie at points at the most: points are exact, but lie where corners are.
const POINTS_SHARE: usize = 2;

/// A round Gaussian.
struct Ball {
    mean: DVec3,
    scale: f64,
    colour: [f32; 3],
}

/// `count` Gaussians where the photos agree on what they show, and at `points` of the scene, where some are known. Each is as large
/// as the part of the pictures that it stands for. Two views at least.
pub fn gaussians_from_photos(views: &[View], points: &[Point], count: usize, seed: u64) -> RawGaussians {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let swept = sweep(views, points);
    let pixels: f64 = swept.iter().map(|s| f64::from(s.camera.width * s.camera.height)).sum();
    let spacing = (pixels / count as f64).sqrt(); // in pixels of these small pictures
    let chosen = sample(&mut random, points.len(), points.len().min(count / POINTS_SHARE));
    let mut balls: Vec<Ball> = chosen.iter().map(|i| at_point(&points[i], &swept, spacing)).collect();
    let left = count - balls.len();
    for (index, of) in swept.iter().enumerate() {
        // Shares that add up.
        let share = |i: usize| left * i / swept.len();
        in_picture(of, share(index + 1) - share(index), spacing, &mut random, &mut balls);
    }
    raw(&balls)
}

/// As large as if the camera that is nearest had seen it.
fn at_point(point: &Point, swept: &[Swept], spacing: f64) -> Ball {
    let size =
        |of: &Swept| point.position.distance(of.camera.c2w.w_axis.truncate()) / of.camera.intrinsics.fx;
    let least = swept.iter().map(size).fold(f64::INFINITY, f64::min);
    Ball { mean: point.position, scale: EXTENT * spacing * least, colour: point.colour }
}

/// `count` Gaussians at pixels of `of`, anywhere.
fn in_picture(of: &Swept, count: usize, spacing: f64, random: &mut impl Rng, balls: &mut Vec<Ball>) {
    let (width, height) = (of.camera.width as usize, of.camera.height as usize);
    let numbers = |t: &Tensor| Vec::<f32>::try_from(t.contiguous().view([-1])).expect("numbers");
    let (depth, image, k) = (numbers(&of.depth), numbers(&of.image), of.camera.intrinsics);
    for _ in 0..count {
        let (u, v) = (random.random_range(0. ..width as f64), random.random_range(0. ..height as f64));
        let pixel = v as usize * width + u as usize;
        let z = f64::from(depth[pixel]);
        let seen = DVec3::new((u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z);
        balls.push(Ball {
            mean: of.camera.c2w.transform_point3(seen),
            scale: EXTENT * spacing * z / k.fx,
            colour: [0, 1, 2].map(|channel| image[channel * width * height + pixel]),
        });
    }
}

fn raw(balls: &[Ball]) -> RawGaussians {
    let n = balls.len() as i64;
    let of = |values: Vec<f64>, shape: &[i64]| Tensor::from_slice(&values).to_kind(Kind::Float).view(shape);
    let colours = balls.iter().flat_map(|ball| ball.colour.map(|c| (f64::from(c) - 0.5) / SH_C0));
    RawGaussians {
        means: of(balls.iter().flat_map(|ball| ball.mean.to_array()).collect(), &[1, n, 3]),
        log_scales: of(balls.iter().flat_map(|ball| [ball.scale.ln(); 3]).collect(), &[1, n, 3]),
        quaternions: of(balls.iter().flat_map(|_| [1., 0., 0., 0.]).collect(), &[1, n, 4]),
        opacity_logits: Tensor::full([1, n], f64::from(LOGIT), (Kind::Float, tch::Device::Cpu)),
        sh: of(colours.collect(), &[1, n, 1, 3]),
    }
}
