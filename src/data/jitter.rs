//! Color jitter with the semantics of torchvision's `ColorJitter` on floating-point images: up to four adjustments in random order,
//! each with its own factor. Every loop runs over whole planes without branches, so that the compiler vectorizes it (spec 8.4).

use super::config::JitterConfig;
use globalsplat_capture::CHANNELS;
use rand::Rng;
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};

/// Weights of the color channels in the grey value, as in torchvision.
const GREY: [f32; CHANNELS] = [0.2989, 0.587, 0.114];

/// A color adjustment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Adjustment {
    /// Factor on all color values.
    Brightness(f32),
    /// Factor on the distance from the image's mean grey.
    Contrast(f32),
    /// Factor on the distance from the pixel's grey.
    Saturation(f32),
    /// Rotation of the hue as a fraction of the full circle, −½ to ½.
    Hue(f32),
}

/// A sequence of color adjustments.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Jitter {
    /// Adjustments in the order of application.
    pub adjustments: Vec<Adjustment>,
}

impl Jitter {
    /// Draws uniform factors within the limits of `config`, and a random order.
    pub fn draw(config: &JitterConfig, random: &mut impl Rng) -> Self {
        let mut factor = |strength: f64| random.random_range((1. - strength).max(0.)..=1. + strength) as f32;
        let mut adjustments = vec![
            Adjustment::Brightness(factor(config.brightness)),
            Adjustment::Contrast(factor(config.contrast)),
            Adjustment::Saturation(factor(config.saturation)),
            Adjustment::Hue(random.random_range(-config.hue..=config.hue) as f32),
        ];
        adjustments.shuffle(random);
        adjustments.retain(|adjustment| match *adjustment {
            Adjustment::Brightness(_) => config.brightness > 0.,
            Adjustment::Contrast(_) => config.contrast > 0.,
            Adjustment::Saturation(_) => config.saturation > 0.,
            Adjustment::Hue(_) => config.hue > 0.,
        });
        Jitter { adjustments }
    }

    /// Adjusts 8-bit `planes`, `[3, H, W]`, and rounds once, at the end. `scratch` is a buffer for reuse; its contents don't
    /// matter.
    pub fn apply_to_bytes(&self, planes: &mut [u8], scratch: &mut Vec<f32>) {
        if self.adjustments.is_empty() {
            return;
        }
        scratch.clear();
        scratch.extend(planes.iter().map(|&byte| f32::from(byte) / 255.));
        self.apply(scratch);
        for (byte, value) in planes.iter_mut().zip(scratch) {
            // Adding 2^23 leaves the nearest integer in the lowest bits of a float32.
            *byte = (*value * 255. + 8_388_608.).to_bits() as u8;
        }
    }

    /// Adjusts `planes`, `[3, H, W]`, values in [0, 1].
    pub fn apply(&self, planes: &mut [f32]) {
        for adjustment in &self.adjustments {
            match *adjustment {
                Adjustment::Brightness(factor) => {
                    planes.iter_mut().for_each(|value| *value = in_range(*value * factor));
                }
                Adjustment::Contrast(factor) => {
                    let offset = (1. - factor) * mean_grey(planes);
                    planes.iter_mut().for_each(|value| *value = in_range(factor * *value + offset));
                }
                Adjustment::Saturation(factor) => for_pixels(planes, |pixel| {
                    let grey = (1. - factor) * grey(pixel);
                    pixel.map(|value| in_range(factor * value + grey))
                }),
                Adjustment::Hue(turn) => {
                    let shift = 6. * (turn - turn.floor());
                    for_pixels(planes, |pixel| turn_hue(pixel, shift));
                }
            }
        }
    }
}

fn in_range(value: f32) -> f32 {
    value.clamp(0., 1.)
}

fn grey([red, green, blue]: [f32; CHANNELS]) -> f32 {
    GREY[0] * red + GREY[1] * green + GREY[2] * blue
}

fn split(planes: &mut [f32]) -> [&mut [f32]; CHANNELS] {
    let pixels = planes.len() / CHANNELS;
    let (red, rest) = planes.split_at_mut(pixels);
    let (green, blue) = rest.split_at_mut(pixels);
    [red, green, blue]
}

fn for_pixels(planes: &mut [f32], change: impl Fn([f32; CHANNELS]) -> [f32; CHANNELS]) {
    let [red, green, blue] = split(planes);
    for ((red, green), blue) in red.iter_mut().zip(green).zip(blue) {
        [*red, *green, *blue] = change([*red, *green, *blue]);
    }
}

/// Returns the mean grey of the image. Each float32 partial sum covers only a few hundred values, which keeps it accurate.
fn mean_grey(planes: &[f32]) -> f32 {
    const LANES: usize = 16;
    let pixels = planes.len() / CHANNELS;
    let plane_sum = |plane: &[f32]| {
        let mut total = 0f64;
        for block in plane.chunks(LANES * 64) {
            let mut lanes = [0f32; LANES];
            let whole = block.chunks_exact(LANES);
            let rest: f32 = whole.remainder().iter().sum();
            for part in whole {
                lanes.iter_mut().zip(part).for_each(|(lane, value)| *lane += value);
            }
            total += f64::from(lanes.iter().sum::<f32>() + rest);
        }
        total
    };
    let sum: f64 =
        planes.chunks_exact(pixels).zip(GREY).map(|(p, share)| f64::from(share) * plane_sum(p)).sum();
    (sum / pixels as f64) as f32
}

/// Rotates the hue by `shift` sixths of the circle, 0 to 6, with value and chroma unchanged: HSV and back in one formula.
fn turn_hue([red, green, blue]: [f32; CHANNELS], shift: f32) -> [f32; CHANNELS] {
    let (value, least) = (red.max(green).max(blue), red.min(green).min(blue));
    let chroma = value - least;
    let inverse = if chroma > 0. { 1. / chroma } else { 0. };
    // Hues are in sixths of the circle: red is at 0, green at 2, blue at 4.
    let from_red = (green - blue) * inverse;
    let from_green = 2. + (blue - red) * inverse;
    let from_blue = 4. + (red - green) * inverse;
    let hue = if value == red {
        from_red
    } else if value == green {
        from_green
    } else {
        from_blue
    };
    let wrap = |sixths: f32| if sixths >= 6. { sixths - 6. } else { sixths };
    let hue = hue + shift;
    let hue = wrap(if hue < 0. { hue + 6. } else { hue });
    // A channel is at its minimum over two sixths of the circle, at its maximum over two sixths, and linear in between.
    [5., 3., 1.].map(|offset: f32| {
        let from = wrap(offset + hue);
        value - chroma * from.min(4. - from).clamp(0., 1.)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn picture() -> Vec<f32> {
        let mut random = ChaCha8Rng::seed_from_u64(0);
        (0..3 * 40 * 33).map(|_| random.random_range(0f32..=1.)).collect()
    }

    fn adjusted(adjustments: &[Adjustment]) -> Vec<f32> {
        let mut planes = picture();
        Jitter { adjustments: adjustments.to_vec() }.apply(&mut planes);
        planes
    }

    fn farthest(a: &[f32], b: &[f32]) -> f32 {
        a.iter().zip(b).fold(0., |most, (a, b)| most.max((a - b).abs()))
    }

    #[test]
    fn jitter_of_strength_0_is_the_identity() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        assert_eq!(Jitter::draw(&JitterConfig::OFF, &mut random), Jitter::default());
        use Adjustment::*;
        for adjustment in [Brightness(1.), Contrast(1.), Saturation(1.), Hue(0.), Hue(1.)] {
            assert!(farthest(&adjusted(&[adjustment]), &picture()) < 1e-6, "{adjustment:?}");
        }
        let bytes: Vec<u8> = (0..=255).cycle().take(3 * 256).collect();
        let mut same = bytes.clone();
        let nothing = Jitter { adjustments: vec![Brightness(1.), Hue(0.)] };
        nothing.apply_to_bytes(&mut same, &mut vec![]);
        assert_eq!(same, bytes);
    }

    #[test]
    fn factors_and_orders_are_drawn_within_their_limits() {
        let config = JitterConfig { brightness: 0.2, contrast: 2., saturation: 0., hue: 0.5 };
        let mut random = ChaCha8Rng::seed_from_u64(2);
        let mut first = std::collections::BTreeSet::new();
        for _ in 0..200 {
            let jitter = Jitter::draw(&config, &mut random);
            assert_eq!(jitter.adjustments.len(), 3);
            for adjustment in &jitter.adjustments {
                match *adjustment {
                    Adjustment::Brightness(factor) => assert!((0.8..=1.2).contains(&factor)),
                    Adjustment::Contrast(factor) => assert!((0. ..=3.).contains(&factor)),
                    Adjustment::Saturation(_) => panic!("it has no strength"),
                    Adjustment::Hue(turn) => assert!((-0.5..=0.5).contains(&turn)),
                }
            }
            first.insert(format!("{:?}", std::mem::discriminant(&jitter.adjustments[0])));
        }
        assert_eq!(first.len(), 3, "every adjustment comes first sometimes");
    }
}
