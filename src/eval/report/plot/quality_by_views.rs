//! PSNR against the number of context views: the benefit of more photos.

use super::super::entry::{Entry, dataset_name};
use super::super::numbers::decimal;
use super::super::rows::{rows, view_counts};
use super::axes::{Axis, Margins, bounds, frame, polyline};
use super::labels::{shortened, spread};
use super::{HEIGHT, WIDTH, figure, legend, px};
use maud::{Markup, html};

const MARGINS: Margins = Margins::NAMED;
/// Maximum number of characters of a name beside the plot. Longer names are cut; the legend and the tooltips show the full names.
const LONGEST_NAME: usize = 14;

/// Scores of one method for several numbers of context views.
struct Line<'a> {
    name: &'a str,
    measured: Option<&'a Entry<'a>>,
    class: String,
    points: Vec<(usize, f64)>,
}

/// Renders a line for each published and measured method; nothing if there is only one number of views.
pub fn quality_by_views(entries: &[Entry], dataset: &str) -> Markup {
    let counts = view_counts(entries, dataset);
    if counts.len() < 2 {
        return html! {};
    }
    let by_views: Vec<_> = counts.iter().map(|&views| (views, rows(entries, dataset, views))).collect();
    let mut lines: Vec<Line> = vec![];
    for (views, row) in by_views.iter().flat_map(|(views, rows)| rows.iter().map(move |row| (*views, row))) {
        let Some(psnr) = row.psnr else { continue };
        let same =
            |line: &&mut Line| line.name == row.name && line.measured.is_some() == row.measured.is_some();
        match lines.iter_mut().find(same) {
            Some(line) => line.points.push((views, psnr)),
            None => lines.push(Line {
                name: row.name,
                measured: row.measured,
                class: match row.measured {
                    Some(entry) => entry.colour.clone(),
                    None if row.is_published_globalsplat() => "paper".into(),
                    None => "published".into(),
                },
                points: vec![(views, psnr)],
            }),
        }
    }
    // Draw measured lines last, on top of the others.
    lines.sort_by_key(|line| line.measured.is_some());
    let (worst, best) = bounds(lines.iter().flat_map(|line| line.points.iter().map(|point| point.1)));
    let ticks = counts.iter().map(|&views| views as f64).collect();
    let x = Axis::at(ticks, MARGINS.left, WIDTH - MARGINS.right);
    let y = Axis::linear(worst, best, HEIGHT - MARGINS.bottom, MARGINS.top);
    let last = |line: &Line| line.points[line.points.len() - 1];
    let ends: Vec<f64> = lines.iter().map(|line| y.pixel(last(line).1)).collect();
    let heights = spread(&ends, MARGINS.top, HEIGHT - MARGINS.bottom);
    let names_at = WIDTH - MARGINS.right + 14.;

    let drawing = html! {
        (frame(&x, &y, "Context views", "PSNR (dB)", |views| decimal(views, 0)))
        @for ((line, end), height) in lines.iter().zip(&ends).zip(&heights) {
            @let from = x.pixel(last(line).0 as f64);
            line.leader x1=(px(from + 6.)) y1=(px(*end)) x2=(px(names_at - 3.)) y2=(px(*height)) {}
            text.name.emphasis[line.class != "published"] x=(px(names_at)) y=(px(height + 4.)) { (shortened(line.name, LONGEST_NAME)) }
        }
        @for line in &lines {
            @if line.points.len() > 1 {
                polyline.line.(line.class) points=(polyline(line.points.iter().map(|&(views, psnr)| (views as f64, psnr)), &x, &y)) {}
            }
            @for &(views, psnr) in &line.points {
                circle.point.(line.class) cx=(px(x.pixel(views as f64))) cy=(px(y.pixel(psnr)))
                    r=(if line.measured.is_some() { "6" } else { "4" }) {
                    title { (line.name) ", " (views) " context views: " (decimal(psnr, 2)) " dB" }
                }
            }
        }
    };
    let published = |class: &str| lines.iter().any(|line| line.class == class);
    let measured = lines.iter().filter_map(|line| line.measured);
    let legend = legend(published("published"), published("paper"), measured);
    let dataset = dataset_name(dataset);
    let about = format!(
        "PSNR against the number of context views on {dataset}; the numbers are in the tables below."
    );
    figure(&format!("Quality by context views: {dataset}"), &about, drawing, legend)
}
