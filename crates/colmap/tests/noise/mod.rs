//! Photos without anything in common.

use std::path::Path;

/// Writes 4 photos that share nothing.
pub fn write_noise(folder: &Path) {
    std::fs::create_dir_all(folder).unwrap();
    for index in 0..4u32 {
        let noise = image::RgbImage::from_fn(200, 200, |x, y| {
            let mut state = (index << 20 | x << 10 | y).wrapping_mul(2_654_435_761);
            state ^= state >> 15;
            state = state.wrapping_mul(2_246_822_519);
            image::Rgb([(state >> 24) as u8; 3])
        });
        noise.save(folder.join(format!("{index}.png"))).unwrap();
    }
}
