//! Squares of values over one repeat of a texture, and the shapes that texture families paint on them.

use glam::{FloatExt, IVec2, Vec2, Vec3};
use std::f32::consts::TAU;

/// A square of values whose width is a power of two. It repeats in both directions.
#[derive(Clone)]
pub(super) struct Raster<T> {
    /// Number of values in a row.
    pub size: usize,
    /// Values row by row, the top row first.
    pub values: Vec<T>,
    /// `true` if shapes that leave the raster on one side enter it on the other side; otherwise, the border clips them.
    wraps_around: bool,
}

/// A raster of numbers.
pub(super) type Field = Raster<f32>;
/// A raster of colors in linear RGB.
pub(super) type Canvas = Raster<Vec3>;

impl<T: Copy> Raster<T> {
    /// Creates a raster of `size` × `size` values, row by row.
    pub fn new(size: usize, values: Vec<T>) -> Raster<T> {
        Raster { size, values, wraps_around: true }
    }

    /// Creates a raster that has the same value everywhere.
    pub fn filled(size: usize, value: T) -> Raster<T> {
        Raster::new(size, vec![value; size * size])
    }

    /// Creates a raster from a function of the center of each value's square, in repeats.
    pub fn from_fn(size: usize, mut value: impl FnMut(Vec2) -> T) -> Raster<T> {
        let mut values = Vec::with_capacity(size * size);
        // Visits the centers by nested loops, which an iterator of results doesn't.
        centers(size).for_each(|center| values.push(value(center)));
        Raster::new(size, values)
    }

    /// Returns a raster of the results of `convert` for each value.
    pub fn map<U: Copy>(&self, convert: impl FnMut(T) -> U) -> Raster<U> {
        Raster::new(self.size, self.values.iter().copied().map(convert).collect())
    }

    /// Changes every value by a function of its square's center and its previous value.
    pub fn update(&mut self, mut change: impl FnMut(Vec2, T) -> T) {
        for (value, center) in self.values.iter_mut().zip(centers(self.size)) {
            *value = change(center, *value);
        }
    }

    /// Changes every value by a function of its previous value and of the value of another raster of the same size.
    pub fn update_with<U: Copy>(&mut self, other: &Raster<U>, change: impl Fn(T, U) -> T) {
        for (value, &other) in self.values.iter_mut().zip(&other.values) {
            *value = change(*value, other);
        }
    }

    /// Returns the value whose square contains `uv`.
    pub fn value(&self, uv: Vec2) -> T {
        self.values[self.index((uv * self.size as f32).as_ivec2())]
    }

    /// Returns the index of a value from its column and row, which wrap around.
    fn index(&self, place: IVec2) -> usize {
        let mask = self.size as i32 - 1;
        ((place.y & mask) * (mask + 1) + (place.x & mask)) as usize
    }

    /// Returns the bilinear interpolation of four values at `uv` in repeats.
    fn bilinear(&self, uv: Vec2, lerp: impl Fn(T, T, f32) -> T) -> T {
        let at = uv * self.size as f32 - 0.5;
        let floor = at.floor();
        let part = at - floor;
        let value = |x, y| self.values[self.index(floor.as_ivec2() + IVec2::new(x, y))];
        let row = |y| lerp(value(0, y), value(1, y), part.x);
        lerp(row(0), row(1), part.y)
    }
}

impl Field {
    /// Returns the bilinear interpolation of four values at `uv` in repeats.
    pub fn sample(&self, uv: Vec2) -> f32 {
        self.bilinear(uv, FloatExt::lerp)
    }

    /// Returns the field rescaled to [0, 1].
    pub fn stretched(&self) -> Field {
        let low = self.values.iter().copied().fold(f32::INFINITY, f32::min);
        let high = self.values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let scale = 1. / (high - low).max(1e-6);
        self.map(|value| (value - low) * scale)
    }

    /// Returns the slope in `direction`, per distance between values.
    pub fn slope(&self, direction: Vec2) -> Field {
        Field::from_fn(self.size, |uv| {
            let place = (uv * self.size as f32).as_ivec2();
            let rise =
                |step: IVec2| self.values[self.index(place + step)] - self.values[self.index(place - step)];
            0.5 * Vec2::new(rise(IVec2::X), rise(IVec2::Y)).dot(direction)
        })
    }
}

impl Canvas {
    /// Returns the canvas with a border that clips shapes.
    pub fn without_wrapping(self) -> Canvas {
        Canvas { wraps_around: false, ..self }
    }

    /// Returns the bilinear interpolation of four pixels at `uv` in repeats.
    pub fn sample(&self, uv: Vec2) -> Vec3 {
        self.bilinear(uv, Vec3::lerp)
    }

    /// Returns the mean of the pixels.
    pub fn mean(&self) -> Vec3 {
        self.values.iter().sum::<Vec3>() / self.values.len() as f32
    }

    /// Multiplies each pixel by 1 + `strength` times the value of a field of the same size, at least 0.1.
    pub fn shade(&mut self, field: &Field, strength: f32) {
        self.update_with(field, |pixel, value| pixel * (1. + strength * value).max(0.1));
    }

    /// Paints over the pixels within `reach` of `center`. `paint` returns the color and its coverage for the offset from `center`
    /// in repeats.
    pub fn blend(&mut self, center: Vec2, reach: Vec2, paint: impl Fn(Vec2) -> (Vec3, f32)) {
        let scale = self.size as f32;
        let mut low = ((center - reach) * scale - 0.5).floor().as_ivec2();
        let mut high = ((center + reach) * scale + 0.5).ceil().as_ivec2();
        if !self.wraps_around {
            low = low.max(IVec2::ZERO);
            high = high.min(IVec2::splat(self.size as i32 - 1));
        }
        for y in low.y..=high.y {
            for x in low.x..=high.x {
                let offset = (Vec2::new(x as f32, y as f32) + 0.5) / scale - center;
                let (color, share) = paint(offset);
                if share > 0. {
                    let index = self.index(IVec2::new(x, y));
                    self.values[index] = self.values[index].lerp(color, share.min(1.));
                }
            }
        }
    }

    /// Paints over the pixels within `reach` of `center` that a shape with an edge one pixel soft covers. `paint` returns the color and
    /// the signed distance to the edge for the offset from `center` in repeats.
    pub fn stamp(&mut self, center: Vec2, reach: Vec2, paint: impl Fn(Vec2) -> (Vec3, f32)) {
        let pixels = self.size as f32;
        self.blend(center, reach, |offset| {
            let (color, distance) = paint(offset);
            (color, coverage(distance, pixels))
        });
    }

    /// Fills a shape around `center` with an edge that is one pixel soft.
    pub fn fill(&mut self, center: Vec2, shape: &Shape, color: Vec3) {
        let reach = shape.reach + 1. / self.size as f32;
        self.stamp(center, reach, |offset| (color, shape.distance(offset)));
    }

    /// Draws a line with round ends from `origin + from` to `origin + to`, of half the width `radius`.
    pub fn draw_line(&mut self, origin: Vec2, from: Vec2, to: Vec2, radius: f32, color: Vec3) {
        let middle = 0.5 * (from + to);
        self.fill(origin + middle, &Shape::stroke(from - middle, to - middle, radius), color);
    }
}

/// Returns the centers of a raster's squares row by row, in repeats.
fn centers(size: usize) -> impl Iterator<Item = Vec2> {
    let scale = 1. / size as f32;
    grid(size, size).map(move |center| center * scale)
}

/// Returns the centers of the cells of a grid row by row, in cells.
pub(super) fn grid(columns: usize, rows: usize) -> impl Iterator<Item = Vec2> {
    (0..rows).flat_map(move |y| (0..columns).map(move |x| Vec2::new(x as f32, y as f32) + 0.5))
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
}
