//! Morton order, in which points that are close in space are mostly close in a file.

use crate::splat::bounds;

/// Number of bits of a cell's index along an axis: three of them fill 63 bits.
const BITS: u32 = 21;

/// Returns the indices of `means` along Morton's curve through their bounding box. In the same cell, the lower index comes first.
pub(crate) fn morton_order(means: &[[f32; 3]]) -> Vec<usize> {
    let [low, high] = bounds(means).map(|bound| bound.map(f64::from));
    let code = |&index: &usize| {
        let cells: [u64; 3] = std::array::from_fn(|axis| {
            let width = (high[axis] - low[axis]).max(f64::MIN_POSITIVE);
            let part = (f64::from(means[index][axis]) - low[axis]) / width;
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
    #[test]
    fn corners_of_a_cube_are_in_morton_order() {
        // Corner 5 is at (1, 0, 1): the first axis changes fastest.
        let shuffled = [5, 2, 7, 0, 3, 6, 1, 4];
        let corners = shuffled.map(|corner| [0, 1, 2].map(|axis| (corner >> axis & 1) as f32 * 9. - 4.));
        assert_eq!(super::morton_order(&corners), [3, 6, 1, 4, 7, 0, 5, 2]);
        assert_eq!(super::morton_order(&[[1.; 3]; 3]), [0, 1, 2], "of the same place");
    }
}
