//! Sharpness of small gray images, and motion of the picture from one to the next: the median of the displacements of blocks.
//!
//! Blocks are compared by zero-mean normalized cross-correlation, which doesn't depend on exposure and contrast.

use image::{GrayImage, imageops};

/// Longer side in pixels of the images whose blocks are matched.
const SIDE: u32 = 80;
/// Factor by which these are reduced to find the displacement of the whole picture.
const REDUCTION: i32 = 2;
/// Largest displacement of the whole picture that is found, in parts of its sides: more leaves too small an overlap.
const RANGE: f64 = 0.4;
/// Number of columns and of rows of blocks.
const GRID: i32 = 8;
/// Pixels from the center of a block to its border.
const RADIUS: i32 = 5;
/// Displacement in pixels of a block from that of the whole picture: blocks differ by rotation, zoom and parallax.
const SEARCH: i32 = 5;
/// Smallest part of a block, or of the whole picture, that is compared after a displacement.
const MIN_OVERLAP: f64 = 1. / 3.;
/// Correlation above which blocks show the same.
const MATCH: f64 = 0.7;
/// Variance of a block whose displacement can be found.
const TEXTURE: f64 = 9.;
/// Fewest blocks with texture from which a motion is measured.
const MIN_BLOCKS: usize = 4;
/// Motion after which a frame replaces the reference frame, in units of the longer side. Smaller motion back and forth doesn't add up.
const NEXT_REFERENCE: f64 = 0.02;
/// Motion of a cut, in units of the longer side.
const CUT: f64 = 1.;

/// Returns the sharpness of an image: the mean square of the Laplacian, relative to the variance of the pixels, which makes it independent
/// of exposure. 0 for an image of less than 3 pixels a side.
pub(super) fn sharpness_of(image: &GrayImage) -> f64 {
    /// Variance that matters little in a photo, but makes the noise of a black frame count as blur.
    const LEAST_VARIANCE: f64 = 25.;
    let (width, height) = (image.width() as usize, image.height() as usize);
    if width < 3 || height < 3 {
        return 0.;
    }
    let (mut squares, mut sum, mut square_sum) = (0u64, 0u64, 0u64);
    let rows: Vec<&[u8]> = image.chunks_exact(width).collect();
    for rows in rows.windows(3) {
        for x in 1..width - 1 {
            let [above, here, below] = [0, 1, 2].map(|row: usize| i32::from(rows[row][x]));
            let [left, right] = [x - 1, x + 1].map(|x| i32::from(rows[1][x]));
            squares += u64::from((above + below + left + right - 4 * here).unsigned_abs().pow(2));
            sum += here as u64;
            square_sum += (here * here) as u64;
        }
    }
    let [squares, sum, square_sum] =
        [squares, sum, square_sum].map(|sum| sum as f64 / ((width - 2) * (height - 2)) as f64);
    squares / (square_sum - sum * sum + LEAST_VARIANCE)
}

/// Measures how far the picture moves. It compares frames to a reference frame that is up to [`NEXT_REFERENCE`] away.
#[derive(Default)]
pub(super) struct MotionTracker {
    reference: Option<Frame>,
    /// Motion from the reference frame to the last frame.
    since_reference: f64,
}

impl MotionTracker {
    /// Returns the motion from the last frame to `image`, in units of the longer side: [`CUT`] if they don't show the same, 0 at the first
    /// frame.
    pub(super) fn add(&mut self, image: &GrayImage) -> f64 {
        let frame = Frame::new(image);
        let (motion, is_next) = match &self.reference {
            // A dark or blank frame, such as in a fade, is followed until it shows something.
            Some(reference) if reference.blocks.len() >= MIN_BLOCKS => match reference.displacement(&frame) {
                Some(displacement) => {
                    ((displacement - self.since_reference).max(0.), displacement >= NEXT_REFERENCE)
                }
                None => (CUT, true),
            },
            _ => (0., true),
        };
        self.since_reference += motion;
        if is_next {
            (self.reference, self.since_reference) = (Some(frame), 0.);
        }
        motion
    }
}

/// A frame at the sizes at which it is compared to others.
struct Frame {
    fine: GrayImage,
    coarse: GrayImage,
    /// Centers of the blocks with texture, in pixels of the fine image.
    blocks: Vec<[i32; 2]>,
}

impl Frame {
    fn new(image: &GrayImage) -> Self {
        let factor = image.width().max(image.height()).div_ceil(SIDE);
        let reduce = |image: &GrayImage, factor: u32| {
            imageops::thumbnail(image, (image.width() / factor).max(1), (image.height() / factor).max(1))
        };
        let fine = reduce(image, factor);
        let coarse = reduce(&fine, REDUCTION as u32);
        let center = |index: i32, side: u32| (2 * index + 1) * side as i32 / (2 * GRID);
        let centers =
            (0..GRID * GRID).map(|i| [center(i % GRID, fine.width()), center(i / GRID, fine.height())]);
        // Without texture, nothing correlates.
        let blocks =
            centers.filter(|block| correlate(&fine, &fine, *block, [RADIUS; 2], [0, 0]) > 0.).collect();
        Frame { fine, coarse, blocks }
    }

    /// Returns the median displacement of the blocks from this frame to `other`, in units of the longer side; `None` if too few blocks are
    /// found again.
    fn displacement(&self, other: &Frame) -> Option<f64> {
        let [width, height] = [self.coarse.width(), self.coarse.height()];
        let [center, range] =
            [0.5, RANGE].map(|part| [width, height].map(|side| (f64::from(side) * part) as i32));
        let correlate_all = |shift| correlate(&self.coarse, &other.coarse, center, center, shift);
        let whole = best_match([0, 0], range, correlate_all).0.map(|value| REDUCTION * value);
        let lengths = self.blocks.iter().filter_map(|block| self.block_displacement(other, *block, whole));
        let mut lengths: Vec<f64> = lengths.collect();
        if lengths.len() < MIN_BLOCKS.max(self.blocks.len() / 4) {
            return None;
        }
        lengths.sort_by(f64::total_cmp);
        Some(lengths[lengths.len() / 2] / f64::from(self.fine.width().max(self.fine.height())))
    }

    /// Returns the length of the displacement of the block at `center`, in pixels of the fine image. The search starts at `whole`, the
    /// displacement of the whole picture. Returns `None` if the block isn't found again.
    fn block_displacement(&self, other: &Frame, center: [i32; 2], whole: [i32; 2]) -> Option<f64> {
        let correlate = |shift| correlate(&self.fine, &other.fine, center, [RADIUS; 2], shift);
        let ([x, y], correlation) = best_match(whole, [SEARCH; 2], correlate);
        // The maximum of a parabola through the correlations around the best pixel.
        let fraction = |before: f64, after: f64| {
            let curvature = before + after - 2. * correlation;
            if curvature < 0. { ((before - after) / (2. * curvature)).clamp(-0.5, 0.5) } else { 0. }
        };
        let dx = fraction(correlate([x - 1, y]), correlate([x + 1, y]));
        let dy = fraction(correlate([x, y - 1]), correlate([x, y + 1]));
        (correlation >= MATCH).then(|| (f64::from(x) + dx).hypot(f64::from(y) + dy))
    }
}

/// Returns the shift within `range` of `start` with the highest correlation, and this correlation. If nothing correlates, it is `start`.
fn best_match(start: [i32; 2], range: [i32; 2], correlate: impl Fn([i32; 2]) -> f64) -> ([i32; 2], f64) {
    let mut best = (start, correlate(start));
    for y in -range[1]..=range[1] {
        for x in -range[0]..=range[0] {
            let shift = [start[0] + x, start[1] + y];
            let correlation = correlate(shift);
            if correlation > best.1 {
                best = (shift, correlation);
            }
        }
    }
    best
}

/// Returns the zero-mean normalized cross-correlation, -1 to 1, of the pixels of `from` that are up to `radius` from `center` and those of
/// `to` that are `shift` away from them. Returns 0 if `from` has no texture there or `to` is blank, or if less than [`MIN_OVERLAP`] of the
/// pixels are in both images.
fn correlate(from: &GrayImage, to: &GrayImage, center: [i32; 2], radius: [i32; 2], shift: [i32; 2]) -> f64 {
    let clip = |axis: usize| {
        let [from_side, to_side] = [from, to].map(|image| [image.width(), image.height()][axis] as i32);
        let first = (center[axis] - radius[axis]).max(0).max(-shift[axis]);
        first..(center[axis] + radius[axis] + 1).min(from_side).min(to_side - shift[axis])
    };
    let (columns, rows) = (clip(0), clip(1));
    let area = (2 * radius[0] + 1) * (2 * radius[1] + 1);
    let count = (columns.len() * rows.len()) as f64;
    if count < MIN_OVERLAP * f64::from(area) {
        return 0.;
    }
    let row_of = |image: &GrayImage, x: i32, y: i32| y as usize * image.width() as usize + x as usize;
    let (mut sums, mut squares, mut products) = ([0; 2], [0; 2], 0);
    for y in rows {
        let from_row = &from.as_raw()[row_of(from, columns.start, y)..][..columns.len()];
        let to_row = &to.as_raw()[row_of(to, columns.start + shift[0], y + shift[1])..][..columns.len()];
        for (&a, &b) in from_row.iter().zip(to_row) {
            let [a, b] = [a, b].map(u32::from);
            sums = [sums[0] + a, sums[1] + b];
            squares = [squares[0] + a * a, squares[1] + b * b];
            products += a * b;
        }
    }
    let [mean, other_mean] = sums.map(|sum| f64::from(sum) / count);
    let variance = f64::from(squares[0]) / count - mean * mean;
    let other_variance = f64::from(squares[1]) / count - other_mean * other_mean;
    // Less than the variance of a pixel that differs by one gray level in a hundred is blank.
    if variance < TEXTURE || other_variance < 0.01 {
        return 0.;
    }
    (f64::from(products) / count - mean * other_mean) / (variance * other_variance).sqrt()
}
