//! Weathering of surfaces: dirt, scratches, fading by the sun; and variations like those of a camera's grain and lighting.

use glam::Vec3;
use rand_chacha::ChaCha8Rng;

use super::Purpose;
use super::noise::{fractal, ridged, smooth};
use super::palette;
use super::rng::RandomValues;
use super::shape::smoothstep;
use super::{Canvas, SIZE};

/// Applies some of these effects, each with its own probability.
pub(super) fn weather(random: &mut ChaCha8Rng, canvas: &mut Canvas, purpose: Purpose) {
    let outdoors = matches!(purpose, Purpose::Ground | Purpose::Facade | Purpose::Foliage);
    let often = if outdoors { 1.5 } else { 1. };
    if random.happens(0.18 * often) {
        dirt(random, canvas);
    }
    if random.happens(0.07 * often) {
        scratches(random, canvas);
    }
    if random.happens(0.25) {
        let cells = random.count(1, 3);
        canvas.shade(&fractal(random, SIZE, [cells; 2], 2, 0.5), random.between(0.03, 0.2));
    }
    if random.happens(0.3) {
        let grain = random.one_of(&[64, 128, 256]);
        canvas.shade(&smooth(random, SIZE, [grain; 2]), random.leaning_low(0.01, 0.15));
    }
    if random.happens(0.3) {
        let tint = Vec3::new(random.bell(), random.bell(), random.bell()) * random.between(0.03, 0.15);
        canvas.pixels.iter_mut().for_each(|pixel| *pixel *= 1. + tint);
    }
    if random.happens(0.25) {
        contrast(
            canvas,
            if random.happens(0.6) { random.between(0.25, 0.9) } else { random.between(1.1, 1.5) },
        );
    }
    if random.happens(0.2) {
        let light = random.between(0.5, 1.3);
        canvas.pixels.iter_mut().for_each(|pixel| *pixel *= light);
    }
}

/// Adds patches of dust, moss or soot.
fn dirt(random: &mut ChaCha8Rng, canvas: &mut Canvas) {
    let theme = random.weighted(&[(palette::EARTHS, 4.), (palette::GREYS, 2.), (palette::GREENS, 1.)]);
    let color = palette::color_of(random, theme) * random.between(0.2, 1.);
    let cells = random.one_of(&[[2, 2], [3, 3], [5, 5], [8, 2]]);
    let gain = random.between(0.5, 0.85);
    let patches = fractal(random, SIZE, cells, 6, gain);
    let (level, most) = (random.between(-0.3, 0.9), random.between(0.1, 0.6));
    for (pixel, value) in canvas.pixels.iter_mut().zip(&patches.values) {
        *pixel = pixel.lerp(color, most * smoothstep(level, level + 0.9, *value));
    }
}

/// Adds thin brighter or darker lines.
fn scratches(random: &mut ChaCha8Rng, canvas: &mut Canvas) {
    let cells = random.count(2, 6);
    let lines = ridged(random, SIZE, [cells; 2], 3, 0.6);
    let patches = smooth(random, SIZE, [4; 2]);
    let change = if random.happens(0.5) { random.between(0.1, 0.4) } else { -random.between(0.1, 0.5) };
    let width = random.between(0.05, 0.2);
    for ((pixel, line), patch) in canvas.pixels.iter_mut().zip(&lines.values).zip(&patches.values) {
        let strength = smoothstep(1. - width, 1., *line) * patch.clamp(0., 1.);
        *pixel *= 1. + change * strength;
    }
}

/// Scales the distances from the mean color by a factor.
fn contrast(canvas: &mut Canvas, factor: f32) {
    let mean = canvas.pixels.iter().sum::<Vec3>() / canvas.pixels.len() as f32;
    canvas.pixels.iter_mut().for_each(|pixel| *pixel = mean + (*pixel - mean) * factor);
}
