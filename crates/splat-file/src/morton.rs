//! Morton order, in which points that are close in space are mostly close in a file.

/// Number of bits of a cell's index along an axis: three of them fill 63 bits.
const BITS: u32 = 21;

/// Returns the indices of `means` along Morton's curve through their bounding box. In the same cell, the lower index comes first.
pub(crate) fn morton_order(means: &[[f32; 3]]) -> Vec<usize> {
    let bounds: [(f64, f64); 3] = std::array::from_fn(|axis| {
        means.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), mean| {
            (low.min(f64::from(mean[axis])), high.max(f64::from(mean[axis])))
        })
    });
    let code = |&index: &usize| {
        let cells: [u64; 3] = std::array::from_fn(|axis| {
            let (low, high) = bounds[axis];
            let part = (f64::from(means[index][axis]) - low) / (high - low).max(f64::MIN_POSITIVE);
            (part * f64::from((1 << BITS) - 1)) as u64
        });
        (0..BITS).fold(0, |code, bit| {
            let of_axis = |axis: usize| (cells[axis] >> bit & 1) << (3 * bit + axis as u32);
            code | of_axis(0) | of_axis(1) | of_axis(2)
        })
    };
    let mut order: Vec<usize> = (0..means.len()).collect();
    order.sort_by_cached_key(|index| code(index));
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_of_a_cube_are_in_morton_order() {
        // The corners of a cube, the first axis changing fastest.
        let corners: Vec<[f32; 3]> =
            (0..8).map(|corner| [0, 1, 2].map(|axis| (corner >> axis & 1) as f32 * 9. - 4.)).collect();
        let shuffled = [5, 2, 7, 0, 3, 6, 1, 4];
        let order = morton_order(&shuffled.map(|corner: usize| corners[corner]));
        assert_eq!(order.iter().map(|&index| shuffled[index]).collect::<Vec<_>>(), [0, 1, 2, 3, 4, 5, 6, 7]);
        assert_eq!(morton_order(&[[1.; 3]; 3]), [0, 1, 2], "of the same place");
        assert!(morton_order(&[]).is_empty());
    }
}
