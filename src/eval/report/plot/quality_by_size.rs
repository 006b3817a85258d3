//! PSNR against the number of Gaussians: the quality that a method achieves for its size.

use super::super::numbers::{decimal, short};
use super::super::rows::Row;
use super::axes::{Axis, Margins, bounds, frame};
use super::labels::{Area, place_labels, shortened};
use super::{HEIGHT, WIDTH, figure, legend, px};
use maud::{Markup, html};

const MARGINS: Margins = Margins::NARROW;
/// Maximum number of characters of a name; longer names are cut.
const LONGEST_NAME: usize = 24;

/// Renders a point for each row that has both values. Renders nothing if no measured row has both, or if there is only one point.
pub fn quality_by_size(rows: &[Row], setting: &str) -> Markup {
    let point = |row: &'_ Row| Some((row.kilo_gaussians? * 1e3, row.psnr?));
    // Measured rows come first: their names get the best positions.
    let mut shown: Vec<(&Row, (f64, f64))> = rows.iter().filter_map(|row| Some((row, point(row)?))).collect();
    shown.sort_by_key(|(row, _)| row.measured.is_none());
    if shown.len() < 2 || shown[0].0.measured.is_none() {
        return html! {};
    }
    let (fewest, most) = bounds(shown.iter().map(|(_, point)| point.0.max(1.)));
    let (worst, best) = bounds(shown.iter().map(|(_, point)| point.1));
    let x = Axis::logarithmic(fewest, most, MARGINS.left, WIDTH - MARGINS.right);
    let y = Axis::linear(worst, best, HEIGHT - MARGINS.bottom, MARGINS.top);
    let points: Vec<(f64, f64)> =
        shown.iter().map(|(_, (n, psnr))| (x.pixel(n.max(1.)), y.pixel(*psnr))).collect();
    let names: Vec<String> = shown.iter().map(|(row, _)| shortened(row.name, LONGEST_NAME)).collect();
    let within = Area { left: MARGINS.left, top: 20., right: WIDTH, bottom: HEIGHT - MARGINS.bottom };
    let begins = place_labels(&points, &names, within);

    let drawing = html! {
        (frame(&x, &y, "Gaussians, logarithmic", "PSNR (dB)", count))
        // Draw the names first, so that no name covers a point.
        @for (((row, _), name), (left, base)) in shown.iter().zip(&names).zip(&begins) {
            text.name.emphasis[row.measured.is_some() || row.is_published_globalsplat()] x=(px(*left)) y=(px(*base)) {
                (name)
            }
        }
        // Measured points come first in `shown`; draw them last, on top.
        @for ((row, (_, psnr)), (cx, cy)) in shown.iter().zip(&points).rev() {
            @let label = format!("{}: {} dB with {}K Gaussians", row.name, decimal(*psnr, 2), short(row.kilo_gaussians.unwrap_or(0.)));
            (mark(row, *cx, *cy, &label))
        }
    };
    let published = |globalsplat: bool| {
        shown.iter().any(|(row, _)| row.measured.is_none() && row.is_published_globalsplat() == globalsplat)
    };
    let legend = legend(published(false), published(true), shown.iter().filter_map(|(row, _)| row.measured));
    let title = format!("Quality by size: {setting}");
    let about =
        format!("PSNR against the number of Gaussians, {setting}; the numbers are in the table beside it.");
    figure(&title, &about, drawing, legend)
}

fn mark(row: &Row, cx: f64, cy: f64, label: &str) -> Markup {
    html! {
        @match row.measured {
            Some(entry) => circle.point.(entry.colour) cx=(px(cx)) cy=(px(cy)) r="6.5" { title { (label) } },
            None if row.is_published_globalsplat() => circle.point.paper cx=(px(cx)) cy=(px(cy)) r="5" { title { (label) } },
            None => circle.point.published cx=(px(cx)) cy=(px(cy)) r="4.5" { title { (label) } },
        }
    }
}

/// Formats a tick, such as `10K` or `1M`.
fn count(value: f64) -> String {
    match value {
        v if v >= 1e6 => format!("{}M", short(v * 1e-6)),
        v if v >= 1e3 => format!("{}K", short(v * 1e-3)),
        v => short(v),
    }
}
