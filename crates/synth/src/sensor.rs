//! Camera sensor model from radiance to bytes: exposure, white balance, tone curve, vignetting, noise.

use super::noise::Noise;
use super::scene_builder::SceneBuilder;
use glam::{Vec2, Vec3, vec3};

/// Response of a camera to light. It is constant over a video, except for automatic exposure.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sensor {
    /// Factors that multiply radiance, per channel.
    gain: Vec3,
    /// Softness of the highlights in [0, 1]: 0 clips them, and 1 begins to compress them at half of white.
    shoulder: f32,
    /// Exponent of the values in sRGB.
    contrast: f32,
    saturation: f32,
    /// Fraction of the light that is lost in the corners.
    vignette: f32,
    /// Standard deviation of the noise relative to white: a constant, and the factor of x·(1 − x) for the tone x.
    noise: (f32, f32),
    /// Maximum variation of the exposure, in stops.
    exposure_range: f32,
    exposure_noise: Noise,
    seed: u32,
}

impl Sensor {
    /// Draws a random sensor, exposed for images with the mean radiance `mean`.
    pub fn draw(builder: &SceneBuilder, mean: Vec3) -> Sensor {
        let brightness = mean.element_sum() / 3.;
        let target = 0.2 * builder.log_uniform(0.6, 2.);
        // Automatic white balance removes most of the light's color.
        let neutral = brightness / mean.max(Vec3::splat(0.2 * brightness)).max(Vec3::splat(1e-6));
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
            exposure_range: builder.within(0. ..1f32).powi(3) * 0.25,
            exposure_noise: builder.noise(),
            seed: builder.seed(),
        }
    }

    /// Returns the sensor with the same response in every pixel of every image.
    pub fn without_variation(self) -> Sensor {
        Sensor { vignette: 0., noise: (0., 0.), exposure_range: 0., ..self }
    }

    /// Returns the exposure factor of an image at `time`, which goes from 0 to 1 over the video.
    pub fn exposure(&self, time: f32) -> f32 {
        (self.exposure_range * self.exposure_noise.sample(vec3(4. * time, 0.5, 0.5))).exp2()
    }

    /// Converts radiance to sRGB bytes. `place` in [-1, 1]² is the position in the image. `exposure` is the image's exposure factor.
    /// `frame` and `pixel` determine the noise.
    pub fn bytes(&self, radiance: Vec3, exposure: f32, place: Vec2, frame: u32, pixel: u32) -> [u8; 3] {
        let falloff = 1. - self.vignette * place.length_squared() / 2.;
        let light = radiance * self.gain * exposure * falloff;
        let gray = light.dot(vec3(0.2126, 0.7152, 0.0722));
        let light = (gray + self.saturation * (light - gray)).max(Vec3::ZERO);
        let mut random = PixelRng::new(self.seed, frame, pixel);
        light.to_array().map(|x| {
            let toned = self.tone(x);
            let deviation = self.noise.0 + self.noise.1 * toned * (1. - toned);
            let noisy = encode(toned).powf(self.contrast) + deviation * random.normal();
            (255. * noisy + 0.5).clamp(0., 255.) as u8
        })
    }

    /// Applies the tone curve: the identity up to the knee, which is at least 0.5, and above it a curve that approaches 1.
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

/// Random number generator that is seeded for each pixel, so that results don't depend on the order in which threads render pixels.
#[derive(Debug, Clone, Copy)]
pub(super) struct PixelRng {
    state: u32,
}

impl PixelRng {
    pub fn new(seed: u32, frame: u32, pixel: u32) -> Self {
        let mut rng = PixelRng { state: seed ^ frame.wrapping_mul(0x9e37_79b9) };
        rng.next();
        rng.state ^= pixel.wrapping_mul(0x85eb_ca6b);
        rng.next();
        rng
    }

    /// Returns the next 32 bits of O'Neill's (2014) permuted congruential generator.
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
        exposure_range: 0.,
        exposure_noise: Noise::new(0),
        seed: 3,
    };
    /// Radiance of middle gray: 0.5 in sRGB.
    const MIDDLE: f32 = 0.2142;

    fn gray(sensor: Sensor, radiance: f32, exposure: f32, place: Vec2) -> u8 {
        sensor.bytes(Vec3::splat(radiance), exposure, place, 0, 0)[1]
    }

    #[test]
    fn radiance_is_encoded_as_srgb() {
        let bytes = [0., MIDDLE, 1., 9.].map(|radiance| gray(PLAIN, radiance, 1., Vec2::ZERO));
        assert_eq!(bytes, [0, 128, 255, 255]);
        assert_eq!(gray(PLAIN, MIDDLE / 2., 2., Vec2::ZERO), 128, "half the radiance, twice the exposure");
        let corners = Sensor { vignette: 0.3, ..PLAIN };
        assert_eq!(gray(corners, MIDDLE / 0.7, 1., Vec2::ONE), 128, "vignetting in a corner");
        let red = Sensor { saturation: 0., ..PLAIN }.bytes(Vec3::X, 1., Vec2::ZERO, 0, 0);
        assert!(red[0] == red[1] && red[1] == red[2], "{red:?} has a color");
    }

    #[test]
    fn tone_curve_is_linear_and_then_approaches_white() {
        let sensor = Sensor { shoulder: 1., ..PLAIN };
        let tones: Vec<f32> = (0..400).map(|i| sensor.tone(i as f32 / 100.)).collect();
        assert!(tones.windows(2).all(|pair| pair[0] < pair[1]) && tones[399] < 1.);
        let linear: Vec<f32> = (0..=50).map(|i| i as f32 / 100.).collect();
        assert_eq!(tones[..=50], linear, "linear up to a half");
    }

    #[test]
    fn noise_has_the_given_deviation_and_is_independent_between_frames() {
        let sensor = Sensor { noise: (0.02, 0.), ..PLAIN };
        let bytes = |frame: u32| -> Vec<f32> {
            let byte = |pixel| sensor.bytes(Vec3::splat(MIDDLE), 1., Vec2::ZERO, frame, pixel)[0];
            (0..20_000).map(|pixel| f32::from(byte(pixel))).collect()
        };
        let mean = |values: &[f32]| values.iter().sum::<f32>() / values.len() as f32;
        let (first, second) = (bytes(0), bytes(1));
        let middle = mean(&first);
        let covariance = |a: &[f32], b: &[f32]| {
            mean(&a.iter().zip(b).map(|(a, b)| (a - middle) * (b - middle)).collect::<Vec<_>>())
        };
        let deviation = covariance(&first, &first).sqrt();
        let fits = (middle - 127.5).abs() < 0.2 && (deviation / 5.1 - 1.).abs() < 0.03;
        assert!(fits, "{middle} ± {deviation}");
        assert!(covariance(&first, &second).abs() < 0.03 * 26., "noise of two frames is correlated");
    }

    #[test]
    fn exposure_varies_within_its_range() {
        let sensor = Sensor { exposure_range: 0.25, ..PLAIN };
        let stops: Vec<f32> = (0..50).map(|i| sensor.exposure(i as f32 / 50.).log2()).collect();
        let max = stops.iter().fold(0f32, |max, stop| max.max(stop.abs()));
        assert!((0.02..=0.25).contains(&max), "{max} stops");
        assert_eq!(PLAIN.exposure(0.3), 1.);
    }
}
