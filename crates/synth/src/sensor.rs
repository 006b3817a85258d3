//! Camera sensor model from radiance to bytes: exposure, white balance, tone curve, vignetting, noise.

use super::noise::Noise;
use super::scene_builder::SceneBuilder;
use glam::{Vec2, Vec3, vec3};

/// Response of a camera to light, constant over a video except for automatic exposure.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sensor {
    /// Factors on radiance.
    gain: Vec3,
    /// Softness of the highlight rolloff: 0 clips.
    shoulder: f32,
    /// Exponent on encoded values.
    contrast: f32,
    saturation: f32,
    /// Share of the light that is lost in the corners.
    vignette: f32,
    /// Standard deviation of the noise relative to white: in the dark, and the part that depends on the light.
    noise: (f32, f32),
    /// Maximum variation of the exposure, in stops.
    wandering: f32,
    wander: Noise,
    seed: u32,
}

impl Sensor {
    /// Draws a random sensor for images with the mean radiance `seen`.
    pub fn draw(builder: &mut SceneBuilder, seen: Vec3) -> Sensor {
        let brightness = seen.element_sum() / 3.;
        let target = 0.2 * builder.scaled(0.6, 2.);
        // Automatic white balance removes most of the light's colour.
        let neutral = brightness / seen.max(Vec3::splat(0.2 * brightness)).max(Vec3::splat(1e-6));
        let white = Vec3::ONE.lerp(neutral, builder.within(0.2..0.8));
        let tint = vec3(builder.within(0.94..1.06), 1., builder.within(0.94..1.06));
        let noisy = builder.within(0. ..1f32).powi(3);
        Sensor {
            gain: target / brightness.max(1e-4) * white * tint,
            shoulder: builder.within(0. ..1.),
            contrast: builder.within(0.9..1.2),
            saturation: builder.within(0.7..1.25),
            vignette: builder.within(0. ..1f32).powi(2) * 0.35,
            noise: (0.012 * noisy, 0.03 * noisy),
            wandering: builder.within(0. ..1f32).powi(3) * 0.25,
            wander: builder.noise(),
            seed: builder.within(0..u32::MAX),
        }
    }

    /// Returns the exposure factor of an image taken at `time` in [0, 1] of the video.
    pub fn exposure(&self, time: f32) -> f32 {
        (self.wandering * self.wander.at(vec3(4. * time, 0.5, 0.5))).exp2()
    }

    /// Converts radiance to sRGB bytes for pixel `pixel` of frame `frame`. `place` in [-1, 1]² is the position in the image, and
    /// `exposure` the image's exposure.
    pub fn bytes(&self, radiance: Vec3, exposure: f32, place: Vec2, frame: u32, pixel: u32) -> [u8; 3] {
        let corner = 1. - self.vignette * place.length_squared() / 2.;
        let light = radiance * self.gain * exposure * corner;
        let grey = light.dot(vec3(0.2126, 0.7152, 0.0722));
        let light = (grey + self.saturation * (light - grey)).max(Vec3::ZERO);
        let mut random = Hash::new(self.seed, frame, pixel);
        light.to_array().map(|x| {
            let toned = self.tone(x);
            let deviation = self.noise.0 + self.noise.1 * toned * (1. - toned);
            let noisy = encode(toned).powf(self.contrast) + deviation * random.normal();
            (255. * noisy + 0.5).clamp(0., 255.) as u8
        })
    }

    /// Applies the tone curve: linear up to the knee (at least a half), then approaching 1.
    fn tone(&self, x: f32) -> f32 {
        let knee = 1. - 0.5 * self.shoulder;
        if x <= knee {
            return x;
        }
        let rest = 1. - knee;
        if rest <= 0. { 1. } else { knee + rest * (1. - (-(x - knee) / rest).exp()) }
    }
}

/// Applies the sRGB transfer function (IEC 61966-2-1).
fn encode(x: f32) -> f32 {
    if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.min(1.).powf(1. / 2.4) - 0.055 }
}

/// Random number generator of a pixel, which doesn't depend on the thread.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hash {
    state: u32,
}

impl Hash {
    pub fn new(seed: u32, frame: u32, pixel: u32) -> Self {
        let mut hash = Hash { state: seed ^ frame.wrapping_mul(0x9e37_79b9) };
        hash.next();
        hash.state ^= pixel.wrapping_mul(0x85eb_ca6b);
        hash.next();
        hash
    }

    /// Returns the next value of the permuted congruential generator of O'Neill (2014), 32 bits.
    fn next(&mut self) -> u32 {
        self.state = self.state.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
        let word = ((self.state >> ((self.state >> 28) + 4)) ^ self.state).wrapping_mul(277_803_737);
        (word >> 22) ^ word
    }

    /// Returns a uniform random value in [0, 1).
    pub fn uniform(&mut self) -> f32 {
        (self.next() >> 8) as f32 / (1 << 24) as f32
    }

    /// Returns an approximately normal random value of variance 1: the scaled sum of four uniform values.
    fn normal(&mut self) -> f32 {
        let sum: f32 = (0..4).map(|_| self.uniform()).sum();
        (sum - 2.) * 3f32.sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLAIN: Sensor = Sensor {
        gain: Vec3::ONE,
        shoulder: 0.,
        contrast: 1.,
        saturation: 1.,
        vignette: 0.,
        noise: (0., 0.),
        wandering: 0.,
        wander: Noise::new(0),
        seed: 3,
    };
    /// Radiance of middle grey: 0.5 in sRGB.
    const MIDDLE: f32 = 0.2142;

    fn grey(sensor: Sensor, radiance: f32, exposure: f32, place: Vec2) -> u8 {
        sensor.bytes(Vec3::splat(radiance), exposure, place, 0, 0)[1]
    }

    #[test]
    fn light_becomes_srgb() {
        let bytes = [0., MIDDLE, 1., 9.].map(|radiance| grey(PLAIN, radiance, 1., Vec2::ZERO));
        assert_eq!(bytes, [0, 128, 255, 255]);
        assert_eq!(grey(PLAIN, MIDDLE / 2., 2., Vec2::ZERO), 128, "twice the exposure");
        let corners = Sensor { vignette: 0.3, ..PLAIN };
        assert_eq!(grey(corners, MIDDLE / 0.7, 1., Vec2::ONE), 128, "corners lose their share");
        let red = Sensor { saturation: 0., ..PLAIN }.bytes(Vec3::X, 1., Vec2::ZERO, 0, 0);
        assert!(red[0] == red[1] && red[1] == red[2], "{red:?} has a colour");
    }

    #[test]
    fn bright_light_ends_softly_and_in_order() {
        let sensor = Sensor { shoulder: 1., ..PLAIN };
        let tones: Vec<f32> = (0..400).map(|i| sensor.tone(i as f32 / 100.)).collect();
        assert!(tones.windows(2).all(|pair| pair[0] < pair[1]) && tones[399] < 1.);
        assert_eq!(
            tones[..=50],
            (0..=50).map(|i| i as f32 / 100.).collect::<Vec<_>>(),
            "linear up to a half"
        );
    }

    #[test]
    fn noise_is_as_strong_as_it_says_and_new_in_every_frame() {
        let sensor = Sensor { noise: (0.02, 0.), ..PLAIN };
        let bytes = |frame: u32| -> Vec<f32> {
            let byte = |pixel| sensor.bytes(Vec3::splat(MIDDLE), 1., Vec2::ZERO, frame, pixel)[0];
            (0..20_000).map(|pixel| f32::from(byte(pixel))).collect()
        };
        let mean = |of: &[f32]| of.iter().sum::<f32>() / of.len() as f32;
        let (first, second) = (bytes(0), bytes(1));
        let middle = mean(&first);
        let together = |a: &[f32], b: &[f32]| {
            mean(&a.iter().zip(b).map(|(a, b)| (a - middle) * (b - middle)).collect::<Vec<_>>())
        };
        let deviation = together(&first, &first).sqrt();
        assert!(
            (middle - 127.5).abs() < 0.2 && (deviation / 5.1 - 1.).abs() < 0.03,
            "{middle} ± {deviation}"
        );
        assert!(together(&first, &second).abs() < 0.03 * 26., "the same noise twice");
    }

    #[test]
    fn exposure_wanders_as_far_as_it_may() {
        let sensor = Sensor { wandering: 0.25, ..PLAIN };
        let stops: Vec<f32> = (0..50).map(|i| sensor.exposure(i as f32 / 50.).log2()).collect();
        let most = stops.iter().fold(0f32, |most, stop| most.max(stop.abs()));
        assert!((0.02..=0.25).contains(&most), "{most} doublings");
        assert_eq!(PLAIN.exposure(0.3), 1.);
    }
}
