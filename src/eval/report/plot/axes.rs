//! From values to pixels, and the frame around a plot.

use super::super::numbers::decimal;
use super::px;
use maud::{Markup, html};

/// Room for what is written around the drawing area: left, top, right, bottom.
#[derive(Clone, Copy)]
pub struct Margins {
    pub left: f64,
    pub top: f64,
    pub right: f64,
    pub bottom: f64,
}

impl Margins {
    pub const NARROW: Margins = Margins { left: 46., top: 34., right: 16., bottom: 48. };
    /// With room for names on the right.
    pub const NAMED: Margins = Margins { right: 138., ..Margins::NARROW };
}

/// Of a linear axis, in dB or scenes: a smaller difference is none to look at.
const LEAST_SPAN: f64 = 1.;

/// Values of one axis and the pixels they go to.
pub struct Axis {
    from: f64,
    to: f64,
    logarithmic: bool,
    start: f64,
    end: f64,
    pub ticks: Vec<f64>,
}

impl Axis {
    /// Even, with round ticks that enclose `from` to `to`.
    pub fn linear(from: f64, to: f64, start: f64, end: f64) -> Self {
        let step = round_step((to - from).max(LEAST_SPAN) / 5.);
        let (first, last) = ((from / step).floor(), (to / step).ceil().max((from / step).floor() + 1.));
        let ticks = (0..=(last - first) as usize).map(|i| (first + i as f64) * step).collect();
        Axis { from: first * step, to: last * step, logarithmic: false, start, end, ticks }
    }

    /// Even, with these ticks, and room beyond the outermost.
    pub fn at(ticks: Vec<f64>, start: f64, end: f64) -> Self {
        let (least, most) = (ticks[0], ticks[ticks.len() - 1]);
        let room = ((most - least) * 0.06).max(1.);
        Axis { from: least - room, to: most + room, logarithmic: false, start, end, ticks }
    }

    /// Logarithmic, with powers of ten that enclose `from` to `to`, which are positive.
    pub fn logarithmic(from: f64, to: f64, start: f64, end: f64) -> Self {
        let (first, last) = (from.log10().floor(), to.log10().ceil().max(from.log10().floor() + 1.));
        let ticks = (0..=(last - first) as i32).map(|i| 10f64.powi(first as i32 + i)).collect();
        Axis { from: first, to: last, logarithmic: true, start, end, ticks }
    }

    /// The pixel of a value.
    pub fn pixel(&self, value: f64) -> f64 {
        let value = if self.logarithmic { value.log10() } else { value };
        self.start + (value - self.from) / (self.to - self.from) * (self.end - self.start)
    }
}

/// 1, 2 or 5 times a power of ten, at least `least`.
fn round_step(least: f64) -> f64 {
    let power = 10f64.powf(least.log10().floor());
    [1., 2., 5., 10.]
        .map(|factor| factor * power)
        .into_iter()
        .find(|step| *step >= least * 0.999)
        .unwrap_or(power)
}

/// The least and the most of them.
pub fn bounds(values: impl IntoIterator<Item = f64>) -> (f64, f64) {
    let widen = |(least, most): (f64, f64), value: f64| (least.min(value), most.max(value));
    values.into_iter().fold((f64::INFINITY, f64::NEG_INFINITY), widen)
}

/// The corners of a polyline through `points`.
pub fn polyline(points: impl Iterator<Item = (f64, f64)>, x: &Axis, y: &Axis) -> String {
    let corners: Vec<_> = points.map(|(u, v)| format!("{},{}", px(x.pixel(u)), px(y.pixel(v)))).collect();
    corners.join(" ")
}

/// Grid lines across, ticks of both axes, and what they measure.
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
