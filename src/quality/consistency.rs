//! How the photos of a capture fit together: which pairs of them look as the depths of one predict, and which photos hang together by such
//! pairs.

use crate::scene::Camera;
use crate::stereo::{
    Agreement, ComparablePhoto, PhotoSurface, PlaneSweepOutput, are_near_duplicates, nearest_first,
};
use rayon::prelude::*;

/// Number of photos, the nearest that aren't near duplicates, that each photo with depths is compared with.
const COMPARED_PHOTOS: usize = 16;
/// Minimum fraction of a photo's patches that another one must show for a comparison.
const MIN_OVERLAP: f64 = 0.1;
/// Minimum agreement, corrected for chance, of two photos whose poses are right: in units of the median over all pairs, as photos with much
/// that is occluded agree less, and at least.
const MIN_KAPPA: (f64, f64) = (0.3, 0.15);
/// Minimum size of a part of the photos that stands apart from the others, as a fraction of all photos and in photos.
const MIN_PART: (f64, usize) = (0.15, 3);
/// Minimum number of pairs of photos of two groups that contradict their poses, for the groups to contradict each other.
const MIN_CONTRADICTIONS: usize = 3;

/// Pair of photos that show the same surfaces if their poses are right.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pair {
    pub photos: [usize; 2],
    /// `true` if the photos look alike there.
    pub is_consistent: bool,
}

/// Compares each of `surfaces`, the surfaces of photos with their indices, with the `photos` nearest to it.
pub(super) fn compare_pairs(
    swept: &PlaneSweepOutput,
    surfaces: &[(usize, PhotoSurface)],
    photos: &[ComparablePhoto],
) -> Vec<Pair> {
    let cameras: Vec<Camera> = photos.iter().map(|photo| photo.camera).collect();
    let depths: Vec<f64> =
        swept.depth_maps.iter().map(|(_, map)| map.depth.median().double_value(&[])).collect();
    let compare = |((index, surface), depth): (&(usize, PhotoSurface), &f64)| -> Vec<([usize; 2], f64)> {
        let pair = |other: usize| {
            let Agreement { overlap, kappa } = surface.agreement(&photos[other]);
            (overlap > MIN_OVERLAP).then_some(([*index, other], kappa))
        };
        // Any number of near duplicates, as of a camera at rest, count as one.
        let (mut pairs, mut distinct) = (vec![], vec![*index]);
        for other in nearest_first(*index, &cameras) {
            if distinct.iter().all(|&photo| !are_near_duplicates(&cameras[photo], &cameras[other], *depth)) {
                distinct.push(other);
            }
            if distinct.len() > COMPARED_PHOTOS + 1 {
                break;
            }
            pairs.extend(pair(other));
        }
        pairs
    };
    let pairs: Vec<([usize; 2], f64)> = surfaces.par_iter().zip(&depths).flat_map_iter(compare).collect();
    let mut kappas: Vec<f64> = pairs.iter().map(|(_, kappa)| *kappa).collect();
    kappas.sort_by(f64::total_cmp);
    let median = kappas.get(kappas.len() / 2).copied().unwrap_or(0.);
    let least = (MIN_KAPPA.0 * median).max(MIN_KAPPA.1);
    pairs.into_iter().map(|(photos, kappa)| Pair { photos, is_consistent: kappa >= least }).collect()
}

/// Returns the groups of `count` photos that consistent pairs connect, the largest first, each in ascending order. `without` is left out.
fn groups(count: usize, pairs: &[Pair], without: Option<usize>) -> Vec<Vec<usize>> {
    let mut group: Vec<usize> = (0..count).collect();
    for Pair { photos: [a, b], .. } in pairs
        .iter()
        .filter(|pair| pair.is_consistent && !pair.photos.iter().any(|photo| Some(*photo) == without))
    {
        let (from, to) = (group[*a], group[*b]);
        group.iter_mut().filter(|group| **group == from).for_each(|group| *group = to);
    }
    let members =
        |id: usize| (0..count).filter(|&photo| group[photo] == id && Some(photo) != without).collect();
    let mut groups: Vec<Vec<usize>> =
        (0..count).map(members).filter(|group: &Vec<usize>| !group.is_empty()).collect();
    groups.sort_by_key(|group| std::cmp::Reverse(group.len()));
    groups
}

/// How the photos of a capture hang together.
#[derive(Debug, PartialEq)]
pub(super) struct Connections {
    /// Groups of photos that consistent pairs connect, the largest first.
    pub groups: Vec<Vec<usize>>,
    /// Photo that alone connects other photos of the largest group with the rest of it, and these photos.
    pub bridge: Option<(usize, Vec<usize>)>,
    /// `true` if photos of the two largest groups show the same surfaces by their poses, but don't look alike there.
    pub is_contradictory: bool,
}

impl Connections {
    pub fn new(count: usize, pairs: &[Pair]) -> Self {
        let groups_of_all = groups(count, pairs, None);
        let least = ((MIN_PART.0 * count as f64).ceil() as usize).max(MIN_PART.1);
        let largest = &groups_of_all[0];
        let part = |&photo: &usize| {
            let mut parts =
                groups(count, pairs, Some(photo)).into_iter().filter(|group| largest.contains(&group[0]));
            let second = parts.nth(1).filter(|part| part.len() >= least)?;
            Some((photo, second))
        };
        let bridge = largest.iter().filter_map(part).max_by_key(|(_, part)| part.len());
        let is_between = |pair: &&Pair| {
            let [a, b] = pair.photos;
            [(a, b), (b, a)].iter().any(|(a, b)| largest.contains(a) && groups_of_all[1].contains(b))
        };
        let is_contradictory = groups_of_all.get(1).is_some_and(|second| second.len() >= least)
            && pairs.iter().filter(is_between).count() >= MIN_CONTRADICTIONS;
        Connections { bridge, is_contradictory, groups: groups_of_all }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pairs(consistent: &[[usize; 2]], others: &[[usize; 2]]) -> Vec<Pair> {
        let pair = |is_consistent: bool| move |&photos: &[usize; 2]| Pair { photos, is_consistent };
        consistent.iter().map(pair(true)).chain(others.iter().map(pair(false))).collect()
    }

    #[test]
    fn photos_hang_together_by_consistent_pairs() {
        let found = Connections::new(6, &pairs(&[[0, 1], [2, 1], [0, 2], [3, 4]], &[[2, 3], [4, 5]]));
        assert_eq!(found.groups, [vec![0, 1, 2], vec![3, 4], vec![5]]);
        assert_eq!(found.bridge, None);
    }

    #[test]
    fn groups_contradict_each_other_that_should_look_alike() {
        let triangles = [[0, 1], [1, 2], [3, 4], [4, 5]];
        let found = |others: &[[usize; 2]]| Connections::new(6, &pairs(&triangles, others)).is_contradictory;
        assert!(found(&[[0, 3], [4, 1], [2, 5]]));
        assert!(!found(&[[0, 3], [4, 1], [0, 2]]));
    }

    #[test]
    fn a_photo_that_alone_connects_two_parts_is_a_bridge() {
        let triangle = |a: usize| [[a, a + 1], [a + 1, a + 2], [a, a + 2]];
        let halves = [triangle(0), triangle(4)].concat();
        let found = Connections::new(7, &pairs(&[&halves[..], &[[2, 3], [3, 4]]].concat(), &[]));
        assert_eq!(found.groups.len(), 1);
        let (photo, part) = found.bridge.unwrap();
        assert!((2..=4).contains(&photo) && part.len() == 3, "{photo} {part:?}");
        let closed = pairs(&[&halves[..], &[[2, 3], [3, 4], [0, 5], [1, 6]]].concat(), &[]);
        assert_eq!(Connections::new(7, &closed).bridge, None);
    }
}
