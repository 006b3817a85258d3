use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::*;
use Purpose::*;

const PURPOSES: [Purpose; 8] = [Floor, Wall, Ceiling, Ground, Facade, Thing, Foliage, Poster];

/// Returns the mean differences between adjacent columns and between adjacent rows. The last ones are those across the border.
fn steps(canvas: &Canvas) -> [Vec<f32>; 2] {
    let difference = |a: usize, b: usize| (canvas.0[a] - canvas.0[b]).abs().element_sum();
    let mean = |pairs: &dyn Fn(usize) -> f32| (0..SIZE).map(pairs).sum::<f32>() / SIZE as f32;
    let column = |x| mean(&|y| difference(y * SIZE + x, y * SIZE + (x + 1) % SIZE));
    let row = |y| mean(&|x| difference(y * SIZE + x, (y + 1) % SIZE * SIZE + x));
    [(0..SIZE).map(column).collect(), (0..SIZE).map(row).collect()]
}

/// Every family paints finite pixels of a plausible size, and its repeats have no seam, for a purpose that it is likely for.
#[test]
fn families_paint_plausible_surfaces_without_seams() {
    for (index, (family, weights)) in FAMILIES.iter().enumerate() {
        let likely = weights.iter().copied().fold(0., f32::max);
        let purpose = PURPOSES[weights.iter().position(|&weight| weight == likely).expect("its own")];
        for seed in 0..4 {
            let Surface { canvas, repeat_metres } =
                family(&Random::new(ChaCha8Rng::seed_from_u64(seed)), purpose);
            assert!(canvas.0.iter().all(|pixel| pixel.is_finite()), "family {index}");
            assert!((0.02..25.).contains(&repeat_metres), "family {index}: {repeat_metres} m");
            for steps in steps(&canvas) {
                let (across, inside) = steps.split_last().expect("many");
                let largest = inside.iter().copied().fold(0., f32::max);
                let message = format!("family {index}: {across} at the border, {largest} inside");
                assert!(*across <= 1.25 * largest + 0.01, "{message}");
            }
        }
    }
}

/// Reflectance stays in its range, and the mean is that of the texels and a sample with a wide footprint.
#[test]
fn textures_of_all_purposes_are_plausible() {
    let random = &Random::new(ChaCha8Rng::seed_from_u64(6));
    for purpose in [PURPOSES; 3].concat() {
        let texture = Texture::draw(random, purpose);
        let within = |texel: &[u8; 4]| texel[..3].iter().all(|byte| (36..=249).contains(byte));
        assert!(texture.levels.iter().flatten().all(within), "{purpose:?}");
        let texels = &texture.levels[0];
        let sum: Vec3 = texels.iter().map(|&texel| linear_of_texel(texel).truncate()).sum();
        let (found, mean) = (texture.sample(Vec2::ZERO, 1.), sum / texels.len() as f32);
        // Both the single texel and the texels that it is compared with are rounded to bytes.
        assert!((found - mean).abs().max_element() < 0.006, "{purpose:?}: {found} for {mean}");
        for footprint in [1., 3., f32::INFINITY] {
            assert_eq!(texture.sample(random.point() * 9. - 4., footprint), found);
        }
    }
}

#[test]
fn samples_are_periodic_and_continuous_in_footprint() {
    let random = &Random::new(ChaCha8Rng::seed_from_u64(8));
    let texture = Texture::draw(random, Purpose::Floor);

    for _ in 0..100 {
        let uv = random.point();
        let here = texture.sample(uv, 0.01);
        assert!((texture.sample(uv + Vec2::new(2., -3.), 0.01) - here).abs().max_element() < 1e-3);
        assert!((texture.sample(uv, 0.0101) - here).abs().max_element() < 0.01);
    }
}
