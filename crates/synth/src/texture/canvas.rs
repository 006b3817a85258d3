//! Pixel buffer that texture families paint on, and the shapes that they paint.

use glam::{IVec2, Vec2, Vec3};

use super::noise::Field;

/// A square image of linear RGB whose width is a power of two.
#[derive(Clone)]
pub(super) struct Canvas {
    /// Number of pixels in a row.
    pub size: usize,
    /// Pixels row by row, the top row first.
    pub pixels: Vec<Vec3>,
    /// `true` if shapes that leave the canvas on one side enter it on the other.
    pub repeats: bool,
}

impl Canvas {
    /// Creates a canvas from a function of each pixel's center, in repeats.
    pub fn from_fn(size: usize, mut color: impl FnMut(Vec2) -> Vec3) -> Canvas {
        let mut canvas = Canvas::filled(size, Vec3::ZERO);
        canvas.map_pixels(|uv, _| color(uv));
        canvas
    }

    /// Creates a canvas from a field, value by value.
    pub fn from_field(field: &Field, color: impl FnMut(f32) -> Vec3) -> Canvas {
        let pixels = field.values.iter().copied().map(color).collect();
        Canvas { size: field.size, pixels, repeats: true }
    }

    /// Creates a canvas of one color.
    pub fn filled(size: usize, color: Vec3) -> Canvas {
        Canvas { size, pixels: vec![color; size * size], repeats: true }
    }

    /// Creates a canvas of one color whose edges clip shapes.
    pub fn bounded(size: usize, color: Vec3) -> Canvas {
        Canvas { repeats: false, ..Canvas::filled(size, color) }
    }

    /// Changes every pixel by a function of its center and its previous color.
    pub fn map_pixels(&mut self, mut color: impl FnMut(Vec2, Vec3) -> Vec3) {
        let scale = 1. / self.size as f32;
        for (y, row) in self.pixels.chunks_exact_mut(self.size).enumerate() {
            for (x, pixel) in row.iter_mut().enumerate() {
                *pixel = color((Vec2::new(x as f32, y as f32) + 0.5) * scale, *pixel);
            }
        }
    }

    /// Changes every pixel by a function of its previous color and of the value of a field of the same size.
    pub fn map_with_field(&mut self, field: &Field, color: impl Fn(Vec3, f32) -> Vec3) {
        for (pixel, &value) in self.pixels.iter_mut().zip(&field.values) {
            *pixel = color(*pixel, value);
        }
    }

    /// Multiplies each pixel by 1 + `strength` times the value of a field of the same size, at least 0.1.
    pub fn shade(&mut self, field: &Field, strength: f32) {
        self.map_with_field(field, |pixel, value| pixel * (1. + strength * value).max(0.1));
    }

    /// Multiplies all pixels by `factor`.
    pub fn tint(&mut self, factor: Vec3) {
        self.pixels.iter_mut().for_each(|pixel| *pixel *= factor);
    }

    /// Returns the mean of the pixels.
    pub fn mean(&self) -> Vec3 {
        self.pixels.iter().sum::<Vec3>() / self.pixels.len() as f32
    }

    /// Paints over the pixels within `reach` of `center`. `paint` returns the color and its coverage for the offset from `center`
    /// in repeats.
    pub fn stamp(&mut self, center: Vec2, reach: Vec2, paint: impl Fn(Vec2) -> (Vec3, f32)) {
        let scale = self.size as f32;
        let mask = self.size as i32 - 1;
        let mut low = ((center - reach) * scale - 0.5).floor().as_ivec2();
        let mut high = ((center + reach) * scale + 0.5).ceil().as_ivec2();
        if !self.repeats {
            low = low.max(IVec2::ZERO);
            high = high.min(IVec2::splat(mask));
        }
        for y in low.y..=high.y {
            for x in low.x..=high.x {
                let offset = (Vec2::new(x as f32, y as f32) + 0.5) / scale - center;
                let (color, share) = paint(offset);
                if share > 0. {
                    let pixel = &mut self.pixels[((y & mask) * (mask + 1) + (x & mask)) as usize];
                    *pixel = pixel.lerp(color, share.min(1.));
                }
            }
        }
    }

    /// Fills a shape given by its signed distance in repeats, with an edge that is one pixel soft.
    pub fn fill(&mut self, center: Vec2, reach: Vec2, color: Vec3, distance: impl Fn(Vec2) -> f32) {
        let scale = self.size as f32;
        self.stamp(center, reach, |offset| (color, (0.5 - distance(offset) * scale).clamp(0., 1.)));
    }

    /// Returns the bilinear interpolation of four pixels at `uv` in repeats.
    pub fn sample(&self, uv: Vec2) -> Vec3 {
        let at = uv * self.size as f32 - 0.5;
        let floor = at.floor();
        let part = at - floor;
        let mask = self.size - 1;
        let (left, top) = (floor.x as i32 as usize & mask, floor.y as i32 as usize & mask);
        let row = |y: usize| {
            let y = (y & mask) * self.size;
            self.pixels[y + left].lerp(self.pixels[y + ((left + 1) & mask)], part.x)
        };
        row(top).lerp(row(top + 1), part.y)
    }
}

/// Interpolates smoothly from 0 at `low` to 1 at `high`, with zero slope at both ends.
pub(super) fn smoothstep(low: f32, high: f32, value: f32) -> f32 {
    let t = ((value - low) / (high - low)).clamp(0., 1.);
    t * t * (3. - 2. * t)
}

/// Returns the signed distance to a disk.
pub(super) fn disk(offset: Vec2, radius: f32) -> f32 {
    offset.length() - radius
}

/// Returns the signed distance to an ellipse, exact on its edge and approximate elsewhere.
pub(super) fn ellipse(offset: Vec2, radii: Vec2) -> f32 {
    ((offset / radii).length() - 1.) * radii.min_element()
}

/// Returns the signed distance to a rectangle with corners rounded by `rounding`.
pub(super) fn rectangle(offset: Vec2, half: Vec2, rounding: f32) -> f32 {
    let beyond = offset.abs() - half + Vec2::splat(rounding);
    beyond.max(Vec2::ZERO).length() + beyond.max_element().min(0.) - rounding
}

/// Returns the signed distance to a stroke with round ends.
pub(super) fn stroke(offset: Vec2, from: Vec2, to: Vec2, radius: f32) -> f32 {
    let along = to - from;
    let t = ((offset - from).dot(along) / along.length_squared().max(1e-12)).clamp(0., 1.);
    (offset - from - along * t).length() - radius
}

/// Returns the signed distance to a regular polygon with `corners` corners whose inscribed circle has radius `radius`.
pub(super) fn polygon(offset: Vec2, radius: f32, corners: usize) -> f32 {
    let turn = std::f32::consts::TAU / corners as f32;
    let angle = offset.to_angle() / turn;
    offset.length() * ((angle - angle.round()) * turn).cos() - radius
}

/// Returns the approximate signed distance to a flower with `petals` petals, whose notches are `depth` times the radius deep.
pub(super) fn flower(offset: Vec2, radius: f32, petals: usize, depth: f32) -> f32 {
    let wave = (offset.to_angle() * petals as f32).cos();
    offset.length() - radius * (1. - depth * (0.5 - 0.5 * wave))
}

/// Returns the approximate signed distance to a leaf between two points on the x axis, `length` apart and `width` across.
pub(super) fn leaf(offset: Vec2, length: f32, width: f32) -> f32 {
    let t = (offset.x / length + 0.5).clamp(0., 1.);
    let half = 2. * width * t * (1. - t);
    (offset.y.abs() - half).max(offset.x.abs() - 0.5 * length)
}
