//! Squares of values over one repeat of a texture, and the shapes that are painted on them.

use glam::{FloatExt, IVec2, Vec2, Vec3};
use std::f32::consts::TAU;

use super::SIZE;
use crate::random::Random;

/// A square of `SIZE` × `SIZE` values, row by row, the top row first. It repeats in both directions.
#[derive(Clone)]
pub(super) struct Raster<T>(pub Vec<T>);

/// A raster of numbers.
pub(super) type Field = Raster<f32>;
/// A raster of colors in linear RGB.
pub(super) type Canvas = Raster<Vec3>;

impl<T: Copy> Raster<T> {
    /// Creates a raster that has the same value everywhere.
    pub fn filled(value: T) -> Raster<T> {
        Raster(vec![value; SIZE * SIZE])
    }

    /// Creates a raster from a function of the center of each value's square, in repeats.
    pub fn from_fn(value: impl FnMut(Vec2) -> T) -> Raster<T> {
        Raster(centers().map(value).collect())
    }

    /// Returns a raster of the results of `convert` for each value.
    pub fn map<U: Copy>(&self, convert: impl FnMut(T) -> U) -> Raster<U> {
        Raster(self.0.iter().copied().map(convert).collect())
    }

    /// Changes every value by a function of its square's center and its previous value.
    pub fn update(&mut self, mut change: impl FnMut(Vec2, T) -> T) {
        for (value, center) in self.0.iter_mut().zip(centers()) {
            *value = change(center, *value);
        }
    }

    /// Changes every value by a function of its previous value and of the value of another raster.
    pub fn update_with<U: Copy>(&mut self, other: &Raster<U>, change: impl Fn(T, U) -> T) {
        for (value, &other) in self.0.iter_mut().zip(&other.0) {
            *value = change(*value, other);
        }
    }

    /// Returns the value whose square contains `uv`.
    pub fn value(&self, uv: Vec2) -> T {
        self.0[index((uv * SIZE as f32).as_ivec2())]
    }
}

impl Field {
    /// Returns the bilinear interpolation of four values at `uv` in repeats.
    pub fn sample(&self, uv: Vec2) -> f32 {
        let at = uv * SIZE as f32 - 0.5;
        let floor = at.floor();
        let part = at - floor;
        let value = |x, y| self.0[index(floor.as_ivec2() + IVec2::new(x, y))];
        let row = |y| value(0, y).lerp(value(1, y), part.x);
        row(0).lerp(row(1), part.y)
    }

    /// Returns the slope in `direction`, per distance between values.
    pub fn slope(&self, direction: Vec2) -> Field {
        Field::from_fn(|uv| {
            let place = (uv * SIZE as f32).as_ivec2();
            let rise = |step: IVec2| self.0[index(place + step)] - self.0[index(place - step)];
            0.5 * Vec2::new(rise(IVec2::X), rise(IVec2::Y)).dot(direction)
        })
    }
}

impl Canvas {
    /// Returns the mean of the pixels.
    pub fn mean(&self) -> Vec3 {
        self.0.iter().sum::<Vec3>() / self.0.len() as f32
    }

    /// Multiplies each pixel by 1 + `strength` times the value of a field, at least 0.1.
    pub fn shade(&mut self, field: &Field, strength: f32) {
        self.update_with(field, |pixel, value| pixel * (1. + strength * value).max(0.1));
    }

    /// Paints a shape around `center` with an edge that is one pixel soft. `color` is a function of the offset from `center` in
    /// repeats.
    pub fn paint(&mut self, center: Vec2, shape: &Shape, color: impl Fn(Vec2) -> Vec3) {
        let scale = SIZE as f32;
        let low = ((center - shape.reach) * scale - 1.5).floor().as_ivec2();
        let high = ((center + shape.reach) * scale + 1.5).ceil().as_ivec2();
        for y in low.y..=high.y {
            for x in low.x..=high.x {
                let offset = (Vec2::new(x as f32, y as f32) + 0.5) / scale - center;
                let share = coverage((shape.distance)(offset));
                if share > 0. {
                    let pixel = &mut self.0[index(IVec2::new(x, y))];
                    *pixel = pixel.lerp(color(offset), share);
                }
            }
        }
    }

    /// Fills a shape around `center` with one color.
    pub fn fill(&mut self, center: Vec2, shape: &Shape, color: Vec3) {
        self.paint(center, shape, |_| color);
    }
}

/// Returns the index of a value from its column and row, which wrap around.
fn index(place: IVec2) -> usize {
    let mask = SIZE as i32 - 1;
    ((place.y & mask) * (mask + 1) + (place.x & mask)) as usize
}

/// Returns the centers of a raster's squares row by row, in repeats.
fn centers() -> impl Iterator<Item = Vec2> {
    let center = |index: usize| (Vec2::new((index % SIZE) as f32, (index / SIZE) as f32) + 0.5) / SIZE as f32;
    (0..SIZE * SIZE).map(center)
}

/// Interpolates smoothly from 0 at `low` to 1 at `high`, with zero slope at both ends.
pub(super) fn smoothstep(low: f32, high: f32, value: f32) -> f32 {
    let t = ((value - low) / (high - low)).clamp(0., 1.);
    t * t * (3. - 2. * t)
}

/// Returns the share of a pixel that a shape covers, whose edge is at the signed distance `distance` in repeats from the pixel's center.
pub(super) fn coverage(distance: f32) -> f32 {
    (0.5 - distance * SIZE as f32).clamp(0., 1.)
}

/// A shape around the origin; lengths in repeats.
pub(super) struct Shape {
    /// Half the size of a box that contains the shape.
    reach: Vec2,
    /// Signed distance of an offset to the edge, negative inside.
    distance: Box<dyn Fn(Vec2) -> f32>,
}

impl Shape {
    fn new(reach: Vec2, distance: impl Fn(Vec2) -> f32 + 'static) -> Shape {
        Shape { reach, distance: Box::new(distance) }
    }

    /// Creates a rectangle of half the size `half`.
    pub fn rectangle(half: Vec2) -> Shape {
        Shape::new(half, move |offset| (offset.abs() - half).max_element())
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

    /// Creates a flower whose notches are `depth` times the radius deep, with approximate distances; a disk if `depth` is 0.
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
        Shape::new(Vec2::splat(self.reach.length()), move |offset| (self.distance)(turn.rotate(offset)))
    }

    /// Draws a random shape that a circle of `radius` encloses.
    pub fn draw(random: &Random, radius: f32) -> Shape {
        let (slim, corners, depth) = (random.within(0.2..0.8), random.within(3..=8), random.within(0. ..0.8));
        match random.within(0..=3) {
            0 => Shape::rectangle(0.7 * radius * Vec2::new(1., slim)),
            1 => Shape::polygon(0.5 * radius, corners),
            2 => Shape::flower(radius, corners, depth),
            _ => Shape::leaf(2. * radius, slim * radius),
        }
    }
}
