//! Axes: the mapping from values to pixels, and the frame of a plot.

use super::super::numbers::decimal;
use super::px;
use maud::{Markup, html};

/// Margins around the drawing area, in pixels, for labels: left, top, right, bottom.
#[derive(Clone, Copy)]
pub struct Margins {
    pub left: f64,
    pub top: f64,
    pub right: f64,
    pub bottom: f64,
}

impl Margins {
    pub const NARROW: Margins = Margins { left: 46., top: 34., right: 16., bottom: 48. };
    /// Margins with space for names on the right.
    pub const NAMED: Margins = Margins { right: 138., ..Margins::NARROW };
}

/// Minimum range of a linear axis, in dB or scenes. Smaller differences don't matter.
const MIN_SPAN: f64 = 1.;

/// An axis: a range of values and the range of pixels that they map to.
pub struct Axis {
    from: f64,
    to: f64,
    logarithmic: bool,
    start: f64,
    end: f64,
    pub ticks: Vec<f64>,
}

impl Axis {
    /// Creates a linear axis with round ticks that enclose `from` to `to`.
    pub fn linear(from: f64, to: f64, start: f64, end: f64) -> Self {
        let step = round_step((to - from).max(MIN_SPAN) / 5.);
        let (first, last) = ((from / step).floor(), (to / step).ceil().max((from / step).floor() + 1.));
        let ticks = (0..=(last - first) as usize).map(|i| (first + i as f64) * step).collect();
        Axis { from: first * step, to: last * step, logarithmic: false, start, end, ticks }
    }

    /// Creates a linear axis with the given ticks, and some space beyond the outermost ones.
    pub fn at(ticks: Vec<f64>, start: f64, end: f64) -> Self {
        let (least, most) = (ticks[0], ticks[ticks.len() - 1]);
        let room = ((most - least) * 0.06).max(1.);
        Axis { from: least - room, to: most + room, logarithmic: false, start, end, ticks }
    }

    /// Creates a logarithmic axis with powers of ten that enclose `from` to `to`, which are positive.
    pub fn logarithmic(from: f64, to: f64, start: f64, end: f64) -> Self {
        let (first, last) = (from.log10().floor(), to.log10().ceil().max(from.log10().floor() + 1.));
        let ticks = (0..=(last - first) as i32).map(|i| 10f64.powi(first as i32 + i)).collect();
        Axis { from: first, to: last, logarithmic: true, start, end, ticks }
    }

    /// Returns the pixel coordinate of a value.
    pub fn pixel(&self, value: f64) -> f64 {
        let value = if self.logarithmic { value.log10() } else { value };
        self.start + (value - self.from) / (self.to - self.from) * (self.end - self.start)
    }
}

/// Returns the smallest step of at least `least` that is 1, 2 or 5 times a power of ten.
fn round_step(least: f64) -> f64 {
    let power = 10f64.powf(least.log10().floor());
    [1., 2., 5., 10.]
        .map(|factor| factor * power)
        .into_iter()
        .find(|step| *step >= least * 0.999)
        .unwrap_or(power)
}

/// Returns the minimum and the maximum of `values`.
pub fn bounds(values: impl IntoIterator<Item = f64>) -> (f64, f64) {
    let widen = |(least, most): (f64, f64), value: f64| (least.min(value), most.max(value));
    values.into_iter().fold((f64::INFINITY, f64::NEG_INFINITY), widen)
}

/// Returns the `points` attribute of an SVG polyline through `points`.
pub fn polyline(points: impl Iterator<Item = (f64, f64)>, x: &Axis, y: &Axis) -> String {
    let corners: Vec<_> = points.map(|(u, v)| format!("{},{}", px(x.pixel(u)), px(y.pixel(v)))).collect();
    corners.join(" ")
}

/// Renders the horizontal grid lines, the ticks of both axes, and the titles of the axes.
pub fn frame(x: &Axis, y: &Axis, x_title: &str, y_title: &str, x_tick: impl Fn(f64) -> String) -> Markup {
    let digits = if y.ticks.iter().all(|tick| tick.fract().abs() < 1e-9) { 0 } else { 1 };
    html! {
        @for &tick in &y.ticks {
            @let at = y.pixel(tick);
            line.grid x1=(px(x.start)) x2=(px(x.end)) y1=(px(at)) y2=(px(at)) {}
            text.tick.end x=(px(x.start - 7.)) y=(px(at + 4.)) { (decimal(tick, digits)) }
        }
        line.axis x1=(px(x.start)) x2=(px(x.end)) y1=(px(y.start)) y2=(px(y.start)) {}
        @for &tick in &x.ticks {
            @let at = x.pixel(tick);
            line.axis x1=(px(at)) x2=(px(at)) y1=(px(y.start)) y2=(px(y.start + 4.)) {}
            text.tick.middle x=(px(at)) y=(px(y.start + 18.)) { (x_tick(tick)) }
        }
        text.title.end x=(px(x.end)) y=(px(y.start + 37.)) { (x_title) }
        text.title x="4" y=(px(y.end - 14.)) { (y_title) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_enclose_the_values() {
        let axis = Axis::linear(17.76, 29.54, 100., 0.);
        assert_eq!(axis.ticks, [15., 20., 25., 30.]);
        assert_eq!((axis.pixel(15.), axis.pixel(30.), axis.pixel(22.5)), (100., 0., 50.));
        let one_value = Axis::linear(20., 20., 0., 1.);
        assert!(one_value.ticks.len() >= 2 && one_value.pixel(20.).is_finite());
        let axis = Axis::logarithmic(2_000., 3_309_000., 0., 4.);
        assert_eq!(axis.ticks, [1e3, 1e4, 1e5, 1e6, 1e7]);
        assert!((axis.pixel(1e5) - 2.).abs() < 1e-9);
    }
}
