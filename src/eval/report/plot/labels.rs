//! Labels of points, placed so that they cover neither each other nor the points.

/// Height of a label's line in pixels, and an upper estimate of a character's mean width, which few fonts exceed.
const LINE: f64 = 14.;
const CHARACTER: f64 = 7.9;

/// An axis-aligned rectangle in pixels.
#[derive(Clone, Copy, Debug)]
pub struct Area {
    pub left: f64,
    pub top: f64,
    pub right: f64,
    pub bottom: f64,
}

impl Area {
    fn around(x: f64, y: f64, radius: f64) -> Self {
        Area { left: x - radius, top: y - radius, right: x + radius, bottom: y + radius }
    }

    fn overlap(&self, other: &Area) -> f64 {
        let width = self.right.min(other.right) - self.left.max(other.left);
        let height = self.bottom.min(other.bottom) - self.top.max(other.top);
        width.max(0.) * height.max(0.)
    }

    fn size(&self) -> f64 {
        (self.right - self.left) * (self.bottom - self.top)
    }
}

/// Shortens a name to at most `longest` characters. Legends and tooltips show the full name.
pub fn shortened(name: &str, longest: usize) -> String {
    match name.chars().count() > longest {
        true => name.chars().take(longest - 1).chain(['…']).collect(),
        false => name.into(),
    }
}

/// Returns the start of each label's text on its baseline. The points are in the order of their importance: earlier labels get better
/// positions.
pub fn place_labels(points: &[(f64, f64)], names: &[String], within: Area) -> Vec<(f64, f64)> {
    let marks: Vec<Area> = points.iter().map(|&(x, y)| Area::around(x, y, 7.)).collect();
    let mut taken: Vec<Area> = vec![];
    let mut begins = vec![];
    for (&(x, y), name) in points.iter().zip(names) {
        let width = name.chars().count() as f64 * CHARACTER;
        let (right, left, centre) = (x + 9., x - 9. - width, x - width / 2.);
        let near = [0., -12., 12., -20., 20., -30., 30.]
            .into_iter()
            .flat_map(|dy| [(right, dy), (left, dy), (centre, dy)]);
        let areas = near.map(|(left, dy)| {
            let middle = y + dy;
            Area { left, top: middle - LINE / 2., right: left + width, bottom: middle + LINE / 2. }
        });
        let covered = |area: &Area| {
            let others = taken.iter().chain(&marks).map(|other| area.overlap(other)).sum::<f64>();
            others + (area.size() - area.overlap(&within)) * 4.
        };
        // `min_by` returns the first of equal elements, which is the nearest position.
        let best = areas.min_by(|a, b| covered(a).total_cmp(&covered(b))).expect("places");
        begins.push((best.left, best.bottom - 3.));
        taken.push(best);
    }
    begins
}

/// Moves label heights apart until lines of text fit between them. The order is kept and no label moves further than necessary; labels that
/// would overlap are centred on the mean of their heights. All stay within `top` to `bottom` if they fit.
pub fn spread(heights: &[f64], top: f64, bottom: f64) -> Vec<f64> {
    let mut order: Vec<usize> = (0..heights.len()).collect();
    order.sort_by(|&a, &b| heights[a].total_cmp(&heights[b]));
    // After subtracting the lines above it, each height must be at least the previous one. This is isotonic regression: pool adjacent
    // heights (their count and sum) until the means ascend.
    let mut pools: Vec<(usize, f64)> = vec![];
    for (rank, &i) in order.iter().enumerate() {
        let mut pool = (1, heights[i] - rank as f64 * LINE);
        while let Some(&(number, sum)) = pools.last() {
            if sum / number as f64 <= pool.1 / pool.0 as f64 {
                break;
            }
            pool = (pool.0 + number, pool.1 + sum);
            pools.pop();
        }
        pools.push(pool);
    }
    let highest = bottom - (heights.len().max(1) - 1) as f64 * LINE;
    let starts = pools.iter().flat_map(|&(number, sum)| std::iter::repeat_n(sum / number as f64, number));
    let mut spread = heights.to_vec();
    for (rank, (&i, start)) in order.iter().zip(starts).enumerate() {
        spread[i] = start.min(highest).max(top) + rank as f64 * LINE;
    }
    spread
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_keep_clear_of_each_other() {
        let within = Area { left: 0., top: 0., right: 400., bottom: 300. };
        let points = [(200., 150.), (203., 152.), (380., 10.)];
        let begins = place_labels(&points, &["first", "second", "at the edge"].map(String::from), within);
        let areas: Vec<Area> = begins
            .iter()
            .zip([5., 6., 11.])
            .map(|(&(x, y), n)| Area { left: x, top: y - 11., right: x + n * CHARACTER, bottom: y + 3. })
            .collect();
        assert_eq!(areas[0].overlap(&areas[1]), 0.);
        assert!(areas.iter().all(|area| area.overlap(&within) > area.size() - 1e-6), "{areas:?}");
    }

    #[test]
    fn heights_are_spread_in_order() {
        assert_eq!(spread(&[50., 10., 52.], 0., 100.), [44., 10., 58.]);
        assert_eq!(spread(&[99., 98.], 0., 100.), [100., 86.]);
        assert_eq!(spread(&[1., 2., 90.], 0., 100.), [0., 14., 90.]);
    }
}
