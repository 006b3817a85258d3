use rand_chacha::rand_core::SeedableRng;

use super::*;

/// Returns the output of every family, for a purpose that it is likely for, with a few seeds.
fn surfaces() -> impl Iterator<Item = (usize, Surface)> {
    FAMILIES.iter().enumerate().flat_map(|(index, (family, weights))| {
        let likely = weights.iter().copied().fold(0., f32::max);
        let purpose = Purpose::ALL[weights.iter().position(|&weight| weight == likely).expect("its own")];
        (0..4).map(move |seed| (index, family(&mut ChaCha8Rng::seed_from_u64(seed), purpose)))
    })
}

/// Returns the mean differences between adjacent columns and between adjacent rows. The last ones are those across the border.
fn steps(canvas: &Canvas) -> [Vec<f32>; 2] {
    let size = canvas.size;
    let difference = |a: usize, b: usize| (canvas.pixels[a] - canvas.pixels[b]).abs().element_sum();
    let mean = |pairs: &dyn Fn(usize) -> f32| (0..size).map(pairs).sum::<f32>() / size as f32;
    let column = |x| mean(&|y| difference(y * size + x, y * size + (x + 1) % size));
    let row = |y| mean(&|x| difference(y * size + x, (y + 1) % size * size + x));
    [(0..size).map(column).collect(), (0..size).map(row).collect()]
}

#[test]
fn the_same_state_draws_the_same_bytes() {
    for purpose in Purpose::ALL {
        let draw = || {
            let mut random = ChaCha8Rng::seed_from_u64(5);
            [(); 4].map(|()| Texture::draw(&mut random, purpose))
        };
        for (one, other) in draw().iter().zip(&draw()) {
            assert_eq!(one.levels, other.levels, "{purpose:?}");
            assert_eq!(one.repeat_metres.to_bits(), other.repeat_metres.to_bits(), "{purpose:?}");
        }
    }
}

#[test]
fn repeats_have_no_seam() {
    for (family, surface) in surfaces() {
        for steps in steps(&surface.canvas) {
            let (across, inside) = steps.split_last().expect("many");
            let largest = inside.iter().copied().fold(0., f32::max);
            assert!(
                *across <= 1.25 * largest + 0.01,
                "family {family}: {across} at the border, {largest} inside"
            );
        }
    }
}

#[test]
fn texture_families_draw_finite_pixels_of_plausible_size() {
    for (family, surface) in surfaces() {
        assert!(surface.canvas.pixels.iter().all(|pixel| pixel.is_finite()), "family {family}");
        assert!((0.02..25.).contains(&surface.repeat_metres), "family {family}: {} m", surface.repeat_metres);
    }
}

#[test]
fn reflectance_stays_in_range() {
    let mut random = ChaCha8Rng::seed_from_u64(6);
    for purpose in Purpose::ALL {
        for _ in 0..3 {
            let texture = Texture::draw(&mut random, purpose);
            for level in &texture.levels {
                let within = |texel: &[u8; 4]| texel[..3].iter().all(|byte| (36..=249).contains(byte));
                assert!(level.iter().all(within), "{purpose:?}");
            }
        }
    }
}

#[test]
fn mean_equals_a_sample_with_a_wide_footprint() {
    let mut random = ChaCha8Rng::seed_from_u64(7);
    for purpose in Purpose::ALL {
        let texture = Texture::draw(&mut random, purpose);
        let texels = &texture.levels[0];
        let mean =
            texels.iter().map(|&texel| linear_of_texel(texel).truncate()).sum::<Vec3>() / texels.len() as f32;
        // Both the single texel and the texels that it is compared with are rounded to bytes.
        assert!(
            (texture.mean() - mean).abs().max_element() < 0.006,
            "{purpose:?}: {} for {mean}",
            texture.mean()
        );
        for footprint in [1., 3., f32::INFINITY] {
            assert_eq!(texture.sample(random.spot() * 9. - 4., footprint), texture.mean());
        }
    }
}

#[test]
fn samples_are_periodic_and_continuous_in_footprint() {
    let texture = Texture::draw(&mut ChaCha8Rng::seed_from_u64(8), Purpose::Floor);
    let mut random = ChaCha8Rng::seed_from_u64(9);
    for _ in 0..100 {
        let uv = random.spot();
        let here = texture.sample(uv, 0.01);
        assert!((texture.sample(uv + Vec2::new(2., -3.), 0.01) - here).abs().max_element() < 1e-3);
        assert!((texture.sample(uv, 0.0101) - here).abs().max_element() < 0.01);
    }
}

#[test]
fn pictures_are_mirrored_at_their_edges() {
    let picture = RgbImage::from_fn(300, 200, |x, y| image::Rgb([x.min(255) as u8, y as u8, 128]));
    let texture = Texture::from_image(&picture);
    let at = |u, v| texture.sample(Vec2::new(u, v), 0.);
    for (u, v) in [(0.1, 0.2), (0.3, 0.45), (0.01, 0.02)] {
        let here = at(u, v);
        assert!((at(1. - u, v) - here).abs().max_element() < 0.01);
        assert!((at(u, 1. - v) - here).abs().max_element() < 0.01);
        // The middle 200 columns, repeated twice per unit because of the mirror image.
        let expected = palette::linear_of_byte((50. + 400. * u) as u8);
        assert!((here.x - expected.max(0.02)).abs() < 0.02, "{} for {expected}", here.x);
    }
}
