//! Small grey images, of which sharpness and motion are measured.

use std::io::{self, BufRead, ErrorKind};

/// A grey image, rows from the top.
#[derive(Debug, Clone)]
pub(super) struct Grey {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Values of 0 to 255.
    pub(super) pixels: Vec<f32>,
}

impl Grey {
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
        Ok(Some(Grey { width, height, pixels: bytes.into_iter().map(f32::from).collect() }))
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
    pub(super) fn reduce(&self, factor: usize) -> Self {
        let (width, height) = ((self.width / factor).max(1), (self.height / factor).max(1));
        let mut pixels = vec![0.; width * height];
        for (y, row) in self.pixels.chunks(self.width).take(height * factor).enumerate() {
            for (x, value) in row.iter().take(width * factor).enumerate() {
                pixels[y / factor * width + x / factor] += value;
            }
        }
        let scale = 1. / (factor * factor) as f32;
        pixels.iter_mut().for_each(|value| *value *= scale);
        Grey { width, height, pixels }
    }
}
