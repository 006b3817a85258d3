//! Consistency of the photos of a capture: pairs of photos that look as the depths of one predict, and groups of photos that such pairs
//! connect.

use crate::scene::Camera;
use crate::stereo::{
    Agreement, ComparablePhoto, PhotoSurface, PlaneSweepOutput, are_near_duplicates, nearest_first,
};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Number of photos, the nearest that aren't near duplicates, that each photo with depths is compared with.
const COMPARED_PHOTOS: usize = 16;
/// Minimum fraction of a photo's patches that another one must show for a comparison.
const MIN_OVERLAP: f64 = 0.1;
/// Minimum agreement, corrected for chance, of two photos whose poses are right.
const MIN_KAPPA: f64 = 0.15;
/// The same in units of the median over all pairs, if that is more: photos with much that is occluded agree less.
const MIN_RELATIVE_KAPPA: f64 = 0.3;
/// Minimum size of a part of the photos that stands apart from the others, as a fraction of all photos and in photos.
const MIN_PART: (f64, usize) = (0.15, 3);
/// Minimum number of pairs of photos of two groups that contradict their poses, counted in both directions, for the groups to contradict each
/// other.
const MIN_CONTRADICTIONS: usize = 3;

/// Pair of photos that show the same surfaces if their poses are right.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pair {
    pub photos: [usize; 2],
    /// `true` if the photos look alike there.
    pub is_consistent: bool,
    /// `true` if the photos were taken from one place in one direction, so that they look alike with any depths.
    pub is_near_duplicate: bool,
}

/// Compares each of `surfaces`, the surfaces of photos with their indices, with the `photos` nearest to it.
pub(super) fn compare_pairs(
    swept: &PlaneSweepOutput,
    surfaces: &[(usize, PhotoSurface)],
    photos: &[ComparablePhoto],
) -> Vec<Pair> {
    let cameras: Vec<Camera> = photos.iter().map(|photo| photo.camera).collect();
    let depths: Vec<f64> = swept.depth_maps.iter().map(|(_, map)| map.median_depth()).collect();
    // The agreement of each pair; `None` for near duplicates.
    let compare = |((index, surface), depth): (&(usize, PhotoSurface), &f64)| {
        let (mut pairs, mut distinct) = (vec![], vec![*index]);
        for other in nearest_first(*index, &cameras) {
            if distinct.iter().any(|&photo| are_near_duplicates(&cameras[photo], &cameras[other], *depth)) {
                pairs.push(([*index, other], None));
                continue;
            }
            if distinct.len() > COMPARED_PHOTOS {
                break;
            }
            distinct.push(other);
            let Agreement { overlap, kappa } = surface.agreement(&photos[other]);
            if overlap > MIN_OVERLAP {
                pairs.push(([*index, other], Some(kappa)));
            }
        }
        pairs
    };
    let pairs: Vec<([usize; 2], Option<f64>)> =
        surfaces.par_iter().zip(&depths).flat_map_iter(compare).collect();
    let mut kappas: Vec<f64> = pairs.iter().filter_map(|(_, kappa)| *kappa).collect();
    kappas.sort_by(f64::total_cmp);
    let median = kappas.get(kappas.len() / 2).copied().unwrap_or(0.);
    let least = (MIN_RELATIVE_KAPPA * median).max(MIN_KAPPA);
    let pair = |(photos, kappa): ([usize; 2], Option<f64>)| Pair {
        photos,
        is_consistent: kappa.is_none_or(|kappa| kappa >= least),
        is_near_duplicate: kappa.is_none(),
    };
    pairs.into_iter().map(pair).collect()
}

/// Returns the groups of `count` photos that consistent pairs connect, the largest first, each in ascending order. `without` is left out.
fn groups(count: usize, pairs: &[Pair], without: Option<usize>) -> Vec<Vec<usize>> {
    // Each photo points to another one of its group, and one of them to itself (a disjoint-set forest).
    let mut parents: Vec<usize> = (0..count).collect();
    fn root(parents: &mut [usize], mut photo: usize) -> usize {
        while parents[photo] != photo {
            parents[photo] = parents[parents[photo]];
            photo = parents[photo];
        }
        photo
    }
    for Pair { photos, .. } in pairs.iter().filter(|pair| pair.is_consistent) {
        if !photos.iter().any(|photo| Some(*photo) == without) {
            let [a, b] = photos.map(|photo| root(&mut parents, photo));
            parents[a] = b;
        }
    }
    let mut groups = BTreeMap::<usize, Vec<usize>>::new();
    for photo in (0..count).filter(|photo| Some(*photo) != without) {
        groups.entry(root(&mut parents, photo)).or_default().push(photo);
    }
    let mut groups: Vec<Vec<usize>> = groups.into_values().collect();
    groups.sort_by_key(|group| (std::cmp::Reverse(group.len()), group[0]));
    groups
}

/// Connections between the photos of a capture.
#[derive(Debug, PartialEq)]
pub(super) struct Connections {
    /// Groups of photos that consistent pairs connect, the largest first.
    pub groups: Vec<Vec<usize>>,
    /// Photos outside of the largest group, of those that were compared.
    pub apart: Vec<usize>,
    /// Photo that alone connects other photos of the largest group with the rest of it, and these photos.
    pub articulation_photo: Option<(usize, Vec<usize>)>,
    /// `true` if photos of the two largest groups show the same surfaces by their poses, but don't look alike there.
    pub is_contradictory: bool,
}

impl Connections {
    /// Finds the connections of `count` photos, of which those `with_depths` were compared with others, by their `pairs`.
    pub fn new(count: usize, with_depths: &[usize], pairs: &[Pair]) -> Self {
        let groups_of_all = groups(count, pairs, None);
        let least = ((MIN_PART.0 * count as f64).ceil() as usize).max(MIN_PART.1);
        let largest = &groups_of_all[0];
        let part = |&photo: &usize| {
            let parts = groups(count, pairs, Some(photo));
            let mut parts = parts.into_iter().filter(|group| largest.contains(&group[0]));
            let second = parts.nth(1).filter(|part| part.len() >= least)?;
            Some((photo, second))
        };
        let articulation_photo = largest.iter().filter_map(part).max_by_key(|(_, part)| part.len());
        let is_between = |pair: &&Pair| {
            let [a, b] = pair.photos;
            [(a, b), (b, a)].iter().any(|(a, b)| largest.contains(a) && groups_of_all[1].contains(b))
        };
        let is_contradictory = groups_of_all.get(1).is_some_and(|second| second.len() >= least)
            && pairs.iter().filter(is_between).count() >= MIN_CONTRADICTIONS;
        let is_compared = |photo: &usize| {
            with_depths.contains(photo) || pairs.iter().any(|pair| pair.photos.contains(photo))
        };
        let apart = groups_of_all[1..].concat().into_iter().filter(is_compared).collect();
        Connections { apart, articulation_photo, is_contradictory, groups: groups_of_all }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pairs(consistent: &[[usize; 2]], others: &[[usize; 2]]) -> Vec<Pair> {
        let pair = |is_consistent: bool| {
            move |&photos: &[usize; 2]| Pair { photos, is_consistent, is_near_duplicate: false }
        };
        consistent.iter().map(pair(true)).chain(others.iter().map(pair(false))).collect()
    }

    #[test]
    fn consistent_pairs_connect_photos() {
        let found =
            Connections::new(6, &[0, 5], &pairs(&[[0, 1], [2, 1], [0, 2], [3, 4]], &[[2, 3], [4, 5]]));
        assert_eq!(found.groups, [vec![0, 1, 2], vec![3, 4], vec![5]]);
        assert_eq!(found.articulation_photo, None);
    }

    #[test]
    fn groups_contradict_each_other_that_should_look_alike() {
        let triangles = [[0, 1], [1, 2], [3, 4], [4, 5]];
        let found =
            |others: &[[usize; 2]]| Connections::new(6, &[0, 5], &pairs(&triangles, others)).is_contradictory;
        assert!(found(&[[0, 3], [4, 1], [2, 5]]));
        assert!(!found(&[[0, 3], [4, 1], [0, 2]]));
    }

    #[test]
    fn a_photo_that_alone_connects_two_parts_is_found() {
        let triangle = |a: usize| [[a, a + 1], [a + 1, a + 2], [a, a + 2]];
        let halves = [triangle(0), triangle(4)].concat();
        let found = Connections::new(7, &[], &pairs(&[&halves[..], &[[2, 3], [3, 4]]].concat(), &[]));
        assert_eq!(found.groups.len(), 1);
        let (photo, part) = found.articulation_photo.unwrap();
        assert!((2..=4).contains(&photo) && part.len() == 3, "{photo} {part:?}");
        let closed = pairs(&[&halves[..], &[[2, 3], [3, 4], [0, 5], [1, 6]]].concat(), &[]);
        assert_eq!(Connections::new(7, &[], &closed).articulation_photo, None);
    }
}
