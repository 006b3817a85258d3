//! From light to bytes: exposure, white balance, a tone curve, vignetting, noise.

use super::maker::Maker;
use super::noise::Noise;
use glam::{Vec2, Vec3, vec3};

/// A camera's way with light, the same for a whole video but for what exposure does by itself.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sensor {
    /// Factors on radiance.
    gain: Vec3,
    /// How softly bright light ends: 0 cuts it off.
    shoulder: f32,
    /// Exponent on what is shown.
    contrast: f32,
    saturation: f32,
    /// Share of the light that corners lose.
    vignette: f32,
    /// Standard deviation of noise in shares of white, in the dark and from light itself.
    noise: (f32, f32),
    /// How much exposure wanders, in doublings.
    wandering: f32,
    wander: Noise,
    seed: u32,
}

impl Sensor {
    /// For pictures that mean `seen` without it.
    pub fn draw(make: &mut Maker, seen: Vec3) -> Sensor {
        let brightness = seen.element_sum() / 3.;
        let target = 0.2 * make.scaled(0.6, 2.);
        // Cameras take most of the light's colour away.
        let neutral = brightness / seen.max(Vec3::splat(0.2 * brightness)).max(Vec3::splat(1e-6));
        let white = Vec3::ONE.lerp(neutral, make.within(0.2..0.8));
        let tint = vec3(make.within(0.94..1.06), 1., make.within(0.94..1.06));
        let noisy = make.within(0. ..1f32).powi(3);
        Sensor {
            gain: target / brightness.max(1e-4) * white * tint,
            shoulder: make.within(0. ..1.),
            contrast: make.within(0.9..1.2),
            saturation: make.within(0.7..1.25),
            vignette: make.within(0. ..1f32).powi(2) * 0.35,
            noise: (0.012 * noisy, 0.03 * noisy),
            wandering: make.within(0. ..1f32).powi(3) * 0.25,
            wander: make.noise(),
            seed: make.within(0..u32::MAX),
        }
    }

    /// The factor on light that a picture taken at `time` in [0, 1] of the video has.
    pub fn exposure(&self, time: f32) -> f32 {
        (self.wandering * self.wander.at(vec3(4. * time, 0.5, 0.5))).exp2()
    }

    /// sRGB bytes of radiance at `place` in [-1, 1]² of a picture of that `exposure`: of its pixel `pixel`, in frame `frame`.
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

    /// Linear up to a half, then towards 1.
    fn tone(&self, x: f32) -> f32 {
        let knee = 1. - 0.5 * self.shoulder;
        if x <= knee {
            return x;
        }
        let rest = 1. - knee;
        if rest <= 0. { 1. } else { knee + rest * (1. - (-(x - knee) / rest).exp()) }
    }
}

/// sRGB's transfer function (IEC 61966-2-1).
fn encode(x: f32) -> f32 {
    if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.min(1.).powf(1. / 2.4) - 0.055 }
}

/// Random numbers of a pixel, the same on every thread.
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

    /// The permuted congruential generator of O'Neill (2014), 32 bits.
    fn next(&mut self) -> u32 {
        self.state = self.state.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
        let word = ((self.state >> ((self.state >> 28) + 4)) ^ self.state).wrapping_mul(277_803_737);
        (word >> 22) ^ word
    }

    /// In [0, 1).
    pub fn uniform(&mut self) -> f32 {
        (self.next() >> 8) as f32 / (1 << 24) as f32
    }

    /// About normal: the sum of four uniform numbers, of variance 1.
    fn normal(&mut self) -> f32 {
        let sum: f32 = (0..4).map(|_| self.uniform()).sum();
        (sum - 2.) * 3f32.sqrt()
    }
}
