//! Distances between points and their neighbours, by a k-d tree.

use rayon::prelude::*;

/// Number of points in a leaf, which are compared one by one.
const LEAF: usize = 16;

/// Returns the distance of each point to its `k`th nearest other point; infinite if there are fewer.
pub fn neighbour_distances(points: &[[f32; 3]], k: usize) -> Vec<f32> {
    let mut order: Vec<u32> = (0..points.len() as u32).collect();
    sort_by_medians(points, &mut order, 0);
    let distances = points.par_iter().enumerate().map(|(index, point)| {
        let mut nearest = vec![f32::INFINITY; k];
        search(points, &order, 0, (index as u32, point), &mut nearest);
        nearest.last().map_or(0., |square| square.sqrt())
    });
    distances.collect()
}

/// Sorts the indices into a balanced tree: the middle one is the median along an axis, the lower half is before it, the upper half after it,
/// and both halves are trees along the next axis.
fn sort_by_medians(points: &[[f32; 3]], order: &mut [u32], axis: usize) {
    if order.len() <= LEAF {
        return;
    }
    let middle = order.len() / 2;
    let along = |index: &u32| points[*index as usize][axis];
    let (lower, _, upper) = order.select_nth_unstable_by(middle, |a, b| along(a).total_cmp(&along(b)));
    let next = (axis + 1) % 3;
    rayon::join(|| sort_by_medians(points, lower, next), || sort_by_medians(points, upper, next));
}

/// Lowers the ascending squared distances in `nearest` to those of points in the tree `order`, except for the point itself.
fn search(
    points: &[[f32; 3]],
    order: &[u32],
    axis: usize,
    (index, point): (u32, &[f32; 3]),
    nearest: &mut [f32],
) {
    let mut compare = |other: u32| {
        let position = &points[other as usize];
        let square: f32 = point.iter().zip(position).map(|(a, b)| (a - b).powi(2)).sum();
        let place = nearest.partition_point(|&known| known <= square);
        if other != index && place < nearest.len() {
            nearest[place..].rotate_right(1);
            nearest[place] = square;
        }
    };
    if order.len() <= LEAF {
        return order.iter().for_each(|&other| compare(other));
    }
    let middle = order.len() / 2;
    compare(order[middle]);
    let offset = point[axis] - points[order[middle] as usize][axis];
    let (lower, upper) = (&order[..middle], &order[middle + 1..]);
    let (near, far) = if offset < 0. { (lower, upper) } else { (upper, lower) };
    let next = (axis + 1) % 3;
    search(points, near, next, (index, point), nearest);
    if nearest.last().is_some_and(|last| offset * offset < *last) {
        search(points, far, next, (index, point), nearest);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_those_of_all_pairs() {
        let coordinate = |seed: usize| ((seed as f32 * 12.9898).sin() * 43_758.547).fract();
        let points: Vec<[f32; 3]> = (0..500)
            .map(|k| [0, 1, 2].map(|axis| coordinate(3 * k + axis)))
            .chain([[5.; 3], [5.; 3]])
            .collect();
        let found = neighbour_distances(&points, 4);
        for (index, point) in points.iter().enumerate() {
            let distance =
                |other: &[f32; 3]| point.iter().zip(other).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
            let others = points.iter().enumerate().filter(|(other, _)| *other != index);
            let mut all: Vec<f32> = others.map(|(_, other)| distance(other).sqrt()).collect();
            all.sort_by(f32::total_cmp);
            assert_eq!(found[index], all[3], "point {index}");
        }
        assert_eq!(neighbour_distances(&points[..3], 3), [f32::INFINITY; 3]);
        assert!(neighbour_distances(&[], 3).is_empty());
    }
}
