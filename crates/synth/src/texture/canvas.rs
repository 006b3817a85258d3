//! Pixel buffer that texture families paint on, and the shapes that they paint.

use glam::{IVec2, Vec2, Vec3};
use std::f32::consts::TAU;

use super::noise::Field;

/// A square image of linear RGB whose width is a power of two.
#[derive(Clone)]
pub(super) struct Canvas {
    /// Number of pixels in a row.
    pub size: usize,
    /// Pixels row by row, the top row first.
    pub pixels: Vec<Vec3>,
    /// `true` if shapes that leave the canvas on one side enter it on the other side; otherwise, the border clips them.
    wraps_around: bool,
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
        Canvas { size: field.size, pixels, wraps_around: true }
    }

    /// Creates a canvas of one color.
    pub fn filled(size: usize, color: Vec3) -> Canvas {
        Canvas { size, pixels: vec![color; size * size], wraps_around: true }
    }

    /// Returns the canvas with a border that clips shapes.
    pub fn without_wrapping(self) -> Canvas {
        Canvas { wraps_around: false, ..self }
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
        if !self.wraps_around {
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

    /// Fills a shape around `center` with an edge that is one pixel soft.
    pub fn fill(&mut self, center: Vec2, shape: &Shape, color: Vec3) {
        let pixels = self.size as f32;
        self.stamp(center, shape.reach + 1. / pixels, |offset| (color, shape.coverage(offset, pixels)));
    }

    /// Draws a line with round ends from `origin + from` to `origin + to`, of half the width `radius`.
    pub fn draw_line(&mut self, origin: Vec2, from: Vec2, to: Vec2, radius: f32, color: Vec3) {
        let middle = 0.5 * (from + to);
        self.fill(origin + middle, &Shape::stroke(from - middle, to - middle, radius), color);
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

/// Returns the share of a pixel that a shape covers, whose edge is at the signed distance `distance` in repeats from the pixel's center.
/// A repeat has `pixels` pixels.
pub(super) fn coverage(distance: f32, pixels: f32) -> f32 {
    (0.5 - distance * pixels).clamp(0., 1.)
}

/// A shape around the origin; lengths in repeats.
pub(super) struct Shape {
    /// Half the size of a box that contains the shape.
    reach: Vec2,
    distance: Box<dyn Fn(Vec2) -> f32>,
}

impl Shape {
    /// Creates a shape from the signed distance of an offset to its edge, within a box of half the size `reach`.
    pub fn new(reach: Vec2, distance: impl Fn(Vec2) -> f32 + 'static) -> Shape {
        Shape { reach, distance: Box::new(distance) }
    }

    pub fn disk(radius: f32) -> Shape {
        Shape::new(Vec2::splat(radius), move |offset| offset.length() - radius)
    }

    /// Creates an ellipse whose distances are exact on its edge and approximate elsewhere.
    pub fn ellipse(radii: Vec2) -> Shape {
        Shape::new(radii, move |offset| ((offset / radii).length() - 1.) * radii.min_element())
    }

    /// Creates a rectangle of half the size `half`, with corners rounded by `rounding`.
    pub fn rectangle(half: Vec2, rounding: f32) -> Shape {
        Shape::new(half, move |offset| {
            let beyond = offset.abs() - half + Vec2::splat(rounding);
            beyond.max(Vec2::ZERO).length() + beyond.max_element().min(0.) - rounding
        })
    }

    /// Creates a line with round ends.
    pub fn stroke(from: Vec2, to: Vec2, radius: f32) -> Shape {
        let along = to - from;
        Shape::new(from.abs().max(to.abs()) + radius, move |offset| {
            let t = ((offset - from).dot(along) / along.length_squared().max(1e-12)).clamp(0., 1.);
            (offset - from - along * t).length() - radius
        })
    }

    /// Creates a regular polygon with `corners` corners whose inscribed circle has radius `radius`.
    pub fn polygon(radius: f32, corners: usize) -> Shape {
        let turn = TAU / corners as f32;
        // A triangle's corners are at twice its inner radius.
        Shape::new(Vec2::splat(2. * radius), move |offset| {
            let angle = offset.to_angle() / turn;
            offset.length() * ((angle - angle.round()) * turn).cos() - radius
        })
    }

    /// Creates a flower whose notches are `depth` times the radius deep, with approximate distances.
    pub fn flower(radius: f32, petals: usize, depth: f32) -> Shape {
        Shape::new(Vec2::splat(radius), move |offset| {
            let wave = (offset.to_angle() * petals as f32).cos();
            offset.length() - radius * (1. - depth * (0.5 - 0.5 * wave))
        })
    }

    /// Creates a leaf between two points on the x axis, `length` apart and `width` across, with approximate distances.
    pub fn leaf(length: f32, width: f32) -> Shape {
        Shape::new(0.5 * Vec2::new(length, width), move |offset| {
            let t = (offset.x / length + 0.5).clamp(0., 1.);
            let half = 2. * width * t * (1. - t);
            (offset.y.abs() - half).max(offset.x.abs() - 0.5 * length)
        })
    }

    /// Returns the shape rotated by the negative angle of the unit vector `turn`.
    pub fn turned(self, turn: Vec2) -> Shape {
        let reach = if turn == Vec2::X { self.reach } else { Vec2::splat(self.reach.length()) };
        Shape::new(reach, move |offset| (self.distance)(turn.rotate(offset)))
    }

    /// Returns the signed distance of `offset` to the edge.
    pub fn distance(&self, offset: Vec2) -> f32 {
        (self.distance)(offset)
    }

    /// Returns the share of the pixel at `offset` that the shape covers, if a repeat has `pixels` pixels.
    pub fn coverage(&self, offset: Vec2, pixels: f32) -> f32 {
        coverage(self.distance(offset), pixels)
    }
}
