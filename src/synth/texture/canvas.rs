//! What families paint on.

use glam::{IVec2, Vec2, Vec3};

use super::field::Field;

/// A square of linear-light RGB, a power of two wide.
#[derive(Clone)]
pub(super) struct Canvas {
    /// Pixels in a row.
    pub size: usize,
    /// Row by row, the top one first.
    pub pixels: Vec<Vec3>,
    /// Whether what leaves it at one side comes in at the other.
    pub repeats: bool,
}

impl Canvas {
    /// Of a function of each pixel's middle, in repeats.
    pub fn of(size: usize, mut colour: impl FnMut(Vec2) -> Vec3) -> Canvas {
        let mut canvas = Canvas::filled(size, Vec3::ZERO);
        canvas.change(|uv, _| colour(uv));
        canvas
    }

    /// Of a field, number by number.
    pub fn of_field(field: &Field, colour: impl FnMut(f32) -> Vec3) -> Canvas {
        let pixels = field.values.iter().copied().map(colour).collect();
        Canvas { size: field.size, pixels, repeats: true }
    }

    /// Of one colour.
    pub fn filled(size: usize, colour: Vec3) -> Canvas {
        Canvas { size, pixels: vec![colour; size * size], repeats: true }
    }

    /// Of one colour, with edges at which shapes end.
    pub fn bounded(size: usize, colour: Vec3) -> Canvas {
        Canvas { repeats: false, ..Canvas::filled(size, colour) }
    }

    /// Changes every pixel, by its middle and what it was.
    pub fn change(&mut self, mut colour: impl FnMut(Vec2, Vec3) -> Vec3) {
        let scale = 1. / self.size as f32;
        for (y, row) in self.pixels.chunks_exact_mut(self.size).enumerate() {
            for (x, pixel) in row.iter_mut().enumerate() {
                *pixel = colour((Vec2::new(x as f32, y as f32) + 0.5) * scale, *pixel);
            }
        }
    }

    /// Multiplies pixels by 1 and `strength` times a field of the same size.
    pub fn shade(&mut self, field: &Field, strength: f32) {
        for (pixel, value) in self.pixels.iter_mut().zip(&field.values) {
            *pixel *= (1. + strength * value).max(0.1);
        }
    }

    /// Paints over the pixels at most `reach` from `centre`, by a colour and how much of it, of the offset from there in
    /// repeats.
    pub fn stamp(&mut self, centre: Vec2, reach: Vec2, paint: impl Fn(Vec2) -> (Vec3, f32)) {
        let scale = self.size as f32;
        let mask = self.size as i32 - 1;
        let mut low = ((centre - reach) * scale - 0.5).floor().as_ivec2();
        let mut high = ((centre + reach) * scale + 0.5).ceil().as_ivec2();
        if !self.repeats {
            low = low.max(IVec2::ZERO);
            high = high.min(IVec2::splat(mask));
        }
        for y in low.y..=high.y {
            for x in low.x..=high.x {
                let offset = (Vec2::new(x as f32, y as f32) + 0.5) / scale - centre;
                let (colour, share) = paint(offset);
                if share > 0. {
                    let pixel = &mut self.pixels[((y & mask) * (mask + 1) + (x & mask)) as usize];
                    *pixel = pixel.lerp(colour, share.min(1.));
                }
            }
        }
    }

    /// Fills a shape, told by its signed distance in repeats, with an edge one pixel soft.
    pub fn fill(&mut self, centre: Vec2, reach: Vec2, colour: Vec3, distance: impl Fn(Vec2) -> f32) {
        let scale = self.size as f32;
        self.stamp(centre, reach, |offset| (colour, (0.5 - distance(offset) * scale).clamp(0., 1.)));
    }

    /// Between four pixels, at `uv` in repeats.
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
