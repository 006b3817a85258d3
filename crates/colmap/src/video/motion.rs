//! Sharpness of small gray images, and motion of the picture from one to the next: the median of the displacements of blocks, which are matched
//! from coarse to fine.
//!
//! Blocks are compared by zero-mean normalized cross-correlation, which doesn't depend on exposure and contrast.

use std::io::{self, BufRead, ErrorKind};

/// Maximum size of the finest level in pixels.
const FINEST: usize = 160;
/// Number of levels, each half as large as the one before.
const LEVELS: usize = 3;
/// Number of columns and of rows of blocks.
const GRID: isize = 8;
/// Pixels from the center of a block to its border, at every level.
const RADIUS: isize = 5;
/// Largest displacement of the whole picture that is found, in parts of its sides: more leaves too small an overlap.
const RANGE: f32 = 0.4;
/// Displacement in pixels of a block from what the coarser level found. At the coarsest, blocks differ by rotation, zoom and parallax.
const SEARCH: [isize; LEVELS] = [1, 1, 2];
/// Correlation above which blocks show the same.
const MATCH: f32 = 0.7;
/// Variance of a block whose displacement can be found.
const TEXTURE: f32 = 9.;
/// Fewest blocks with texture from which a motion is measured.
const MIN_BLOCKS: usize = 4;
/// Motion after which a frame replaces the reference frame, in units of the longer side. Smaller motion back and forth doesn't add up.
const NEXT_REFERENCE: f64 = 0.02;
/// Motion of a cut, in units of the longer side.
const CUT: f64 = 1.;

/// A gray image, rows from the top.
#[derive(Debug, Clone)]
pub(super) struct Gray {
    width: usize,
    height: usize,
    /// Values of 0 to 255.
    pixels: Vec<f32>,
}

impl Gray {
    /// Reads a binary PGM as ffmpeg writes it: "P5", the size and the maximum, 255, in a line each. Returns `None` at the end of the data.
    pub(super) fn read(reader: &mut impl BufRead) -> io::Result<Option<Self>> {
        if reader.fill_buf()?.is_empty() {
            return Ok(None);
        }
        let mut header = String::new();
        for _ in 0..3 {
            reader.read_line(&mut header)?;
        }
        let words: Vec<&str> = header.split_whitespace().collect();
        let ["P5", width, height, "255"] = words[..] else { return Err(ErrorKind::InvalidData.into()) };
        let parse = |word: &str| word.parse::<usize>().map_err(|_| io::Error::from(ErrorKind::InvalidData));
        let (width, height) = (parse(width)?, parse(height)?);
        let mut bytes = vec![0; width * height];
        reader.read_exact(&mut bytes)?;
        Ok(Some(Gray { width, height, pixels: bytes.into_iter().map(f32::from).collect() }))
    }

    /// Returns the sharpness: the mean square of the Laplacian, relative to the variance of the pixels, which makes it independent of
    /// exposure. 0 for an image of less than 3 pixels a side.
    pub(super) fn sharpness(&self) -> f64 {
        /// Variance that matters little in a photo, but makes the noise of a black frame count as blur.
        const LEAST_VARIANCE: f64 = 25.;
        if self.width < 3 || self.height < 3 {
            return 0.;
        }
        let (mut squares, mut sum, mut square_sum) = (0f64, 0f64, 0f64);
        let row = |y: usize| &self.pixels[y * self.width..][..self.width];
        for y in 1..self.height - 1 {
            let (above, here, below) = (row(y - 1), row(y), row(y + 1));
            let (mut row_squares, mut row_sum, mut row_square_sum) = (0f32, 0f32, 0f32);
            for x in 1..self.width - 1 {
                let laplacian = above[x] + below[x] + here[x - 1] + here[x + 1] - 4. * here[x];
                row_squares += laplacian * laplacian;
                row_sum += here[x];
                row_square_sum += here[x] * here[x];
            }
            squares += f64::from(row_squares);
            sum += f64::from(row_sum);
            square_sum += f64::from(row_square_sum);
        }
        let count = ((self.width - 2) * (self.height - 2)) as f64;
        let variance = square_sum / count - (sum / count).powi(2);
        squares / count / (variance + LEAST_VARIANCE)
    }

    /// Returns the image reduced by an integer `factor`: means of squares of pixels.
    fn reduce(&self, factor: usize) -> Self {
        let (width, height) = ((self.width / factor).max(1), (self.height / factor).max(1));
        let mut pixels = vec![0.; width * height];
        for (y, row) in self.pixels.chunks(self.width).take(height * factor).enumerate() {
            for (x, value) in row.iter().take(width * factor).enumerate() {
                pixels[y / factor * width + x / factor] += value;
            }
        }
        let scale = 1. / (factor * factor) as f32;
        pixels.iter_mut().for_each(|value| *value *= scale);
        Gray { width, height, pixels }
    }

    /// Returns the image at the sizes at which blocks are matched, from the finest to the coarsest.
    fn levels(&self) -> [Gray; LEVELS] {
        let finest = self.reduce(self.width.max(self.height).div_ceil(FINEST));
        let middle = finest.reduce(2);
        let coarsest = middle.reduce(2);
        [finest, middle, coarsest]
    }
}

/// Measures how far the picture moves. It compares frames to a reference frame that is up to [`NEXT_REFERENCE`] away.
#[derive(Default)]
pub(super) struct MotionTracker {
    reference: Option<Reference>,
    /// Motion from the reference frame to the last frame.
    since_reference: f64,
}

impl MotionTracker {
    /// Returns the motion from the last frame to `frame`, in units of the longer side: [`CUT`] if they don't show the same, 0 at the first
    /// frame.
    pub(super) fn add(&mut self, frame: &Gray) -> f64 {
        let levels = frame.levels();
        let Some(reference) = &self.reference else {
            self.reference = Some(Reference::new(levels));
            return 0.;
        };
        let (motion, is_next) = match reference.displacement(&levels) {
            Some(displacement) => {
                let motion = (displacement - self.since_reference).max(0.);
                self.since_reference += motion;
                (motion, displacement >= NEXT_REFERENCE)
            }
            // A dark or blank frame, such as in a fade, is followed until it shows something.
            None if reference.blocks.len() < MIN_BLOCKS => (0., true),
            None => (CUT, true),
        };
        if is_next {
            (self.reference, self.since_reference) = (Some(Reference::new(levels)), 0.);
        }
        motion
    }
}

/// A frame that others are compared to.
struct Reference {
    levels: [Gray; LEVELS],
    /// Centers of the blocks with texture, in pixels of the finest level.
    blocks: Vec<[isize; 2]>,
}

impl Reference {
    fn new(levels: [Gray; LEVELS]) -> Self {
        let finest = &levels[0];
        let center = |index: isize, side: usize| (2 * index + 1) * side as isize / (2 * GRID);
        let centers =
            (0..GRID * GRID).map(|i| [center(i % GRID, finest.width), center(i / GRID, finest.height)]);
        let blocks = centers.filter(|center| Window::around(*center).variance(finest) >= TEXTURE).collect();
        Reference { levels, blocks }
    }

    /// Returns the median displacement of the blocks from this frame to `frame`, in units of the longer side; `None` if too few blocks are
    /// found again.
    fn displacement(&self, frame: &[Gray; LEVELS]) -> Option<f64> {
        if self.blocks.len() < MIN_BLOCKS {
            return None;
        }
        let whole = self.whole_displacement(frame);
        let mut lengths: Vec<f32> =
            self.blocks.iter().filter_map(|block| self.block_displacement(frame, *block, whole)).collect();
        if lengths.len() < MIN_BLOCKS.max(self.blocks.len() / 4) {
            return None;
        }
        lengths.sort_by(f32::total_cmp);
        let finest = &self.levels[0];
        Some(f64::from(lengths[lengths.len() / 2]) / finest.width.max(finest.height) as f64)
    }

    /// Returns the displacement of the whole picture, in pixels of the coarsest level.
    fn whole_displacement(&self, frame: &[Gray; LEVELS]) -> [isize; 2] {
        let (from, to) = (&self.levels[LEVELS - 1], &frame[LEVELS - 1]);
        let range = [from.width, from.height].map(|side| (side as f32 * RANGE) as isize);
        let all = Window { left: 0, top: 0, right: from.width as isize, bottom: from.height as isize };
        best_match([0, 0], range, |shift| all.correlate(from, to, shift, 0.)).0
    }

    /// Returns the length of the displacement of the block at `center`, in pixels of the finest level. The search starts at `shift`, the
    /// displacement of the whole picture. Returns `None` if the block isn't found again.
    fn block_displacement(
        &self,
        frame: &[Gray; LEVELS],
        center: [isize; 2],
        mut shift: [isize; 2],
    ) -> Option<f32> {
        for level in (1..LEVELS).rev() {
            let window = Window::around(center.map(|value| value >> level));
            let correlate = |shift| window.correlate(&self.levels[level], &frame[level], shift, 0.5);
            shift = best_match(shift, [SEARCH[level]; 2], correlate).0.map(|value| 2 * value);
        }
        let window = Window::around(center);
        let correlate = |shift| window.correlate(&self.levels[0], &frame[0], shift, 0.5);
        let (shift @ [x, y], correlation) = best_match(shift, [SEARCH[0]; 2], correlate);
        // The maximum of a parabola through the correlations around the best pixel.
        let fraction = |before: f32, after: f32| {
            let curvature = before + after - 2. * correlation;
            if curvature < 0. { ((before - after) / (2. * curvature)).clamp(-0.5, 0.5) } else { 0. }
        };
        let dx = fraction(correlate([x - 1, y]), correlate([x + 1, y]));
        let dy = fraction(correlate([x, y - 1]), correlate([x, y + 1]));
        (correlation >= MATCH).then(|| (shift[0] as f32 + dx).hypot(shift[1] as f32 + dy))
    }
}

/// Returns the shift within `range` of `start` with the highest correlation, and this correlation. If nothing correlates, it is `start`.
fn best_match(
    start: [isize; 2],
    range: [isize; 2],
    correlate: impl Fn([isize; 2]) -> f32,
) -> ([isize; 2], f32) {
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

/// A rectangle of pixels.
#[derive(Clone, Copy)]
struct Window {
    left: isize,
    top: isize,
    right: isize,
    bottom: isize,
}

impl Window {
    fn around([x, y]: [isize; 2]) -> Self {
        Window { left: x - RADIUS, top: y - RADIUS, right: x + RADIUS + 1, bottom: y + RADIUS + 1 }
    }

    fn area(self) -> isize {
        (self.right - self.left).max(0) * (self.bottom - self.top).max(0)
    }

    /// Returns the part of the window that is in the image `from` and, shifted, in the image `to`.
    fn clip(self, from: &Gray, to: &Gray, [x, y]: [isize; 2]) -> Self {
        Window {
            left: self.left.max(0).max(-x),
            top: self.top.max(0).max(-y),
            right: self.right.min(from.width as isize).min(to.width as isize - x),
            bottom: self.bottom.min(from.height as isize).min(to.height as isize - y),
        }
    }

    /// Returns the pixels of each row of the window, shifted, in `image`.
    fn rows(self, image: &Gray, [x, y]: [isize; 2]) -> impl Iterator<Item = &[f32]> {
        let (left, width) = ((self.left + x) as usize, (self.right - self.left) as usize);
        (self.top..self.bottom)
            .map(move |row| &image.pixels[(row + y) as usize * image.width + left..][..width])
    }

    /// Returns the variance of the pixels of `image` in the window.
    fn variance(self, image: &Gray) -> f32 {
        let window = self.clip(image, image, [0, 0]);
        let (mut sum, mut squares) = (0., 0.);
        for value in window.rows(image, [0, 0]).flatten() {
            sum += value;
            squares += value * value;
        }
        let count = window.area() as f32;
        squares / count - (sum / count).powi(2)
    }

    /// Returns the zero-mean normalized cross-correlation, -1 to 1, of the window in the image `from` and the shifted window in the
    /// image `to`. Returns 0 if one of them is blank, or if no more than a `part` of the window is in the images.
    fn correlate(self, from: &Gray, to: &Gray, shift: [isize; 2], part: f32) -> f32 {
        let window = self.clip(from, to, shift);
        let count = window.area() as f32;
        if count <= part * self.area() as f32 {
            return 0.;
        }
        let (mut sums, mut squares, mut products) = ([0f32; 2], [0f32; 2], 0f32);
        for (a, b) in window.rows(from, [0, 0]).zip(window.rows(to, shift)) {
            for (a, b) in a.iter().zip(b) {
                sums = [sums[0] + a, sums[1] + b];
                squares = [squares[0] + a * a, squares[1] + b * b];
                products += a * b;
            }
        }
        let [a, b] = [0, 1].map(|i| squares[i] - sums[i] * sums[i] / count);
        let covariance = products - sums[0] * sums[1] / count;
        // Less than the variance of a pixel that differs by one gray level in a hundred.
        if a.min(b) < 0.01 * count { 0. } else { covariance / (a * b).sqrt() }
    }
}
