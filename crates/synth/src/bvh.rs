//! Bounding volume hierarchy that finds the nearest triangle along a ray. Each node has four boxes, which are tested at once.

use glam::{Vec3, Vec3A, Vec4};
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::build_bvh2_from_tris;
use obvhs::triangle::Triangle;
use std::time::Duration;

/// Number of boxes per node and of triangles per leaf: the width of a vector.
const WIDTH: usize = 4;
/// Maximum number of levels of a tree. A hundred thousand triangles need about a dozen.
const LEVELS: usize = 32;
/// Maximum size of the traversal stack: the children left on every level, and the root.
const STACK: usize = (WIDTH - 1) * LEVELS + 1;

/// Bounding volume hierarchy of triangles.
#[derive(Default)]
pub(super) struct Bvh {
    nodes: Vec<Node>,
    leaves: Vec<Leaf>,
    root: Child,
}

/// Intersection of a ray with a triangle.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hit {
    /// Index of the triangle.
    pub triangle: usize,
    pub distance: f32,
}

/// Four boxes in structure-of-arrays layout.
struct Node {
    /// Minimum and maximum corners. The sign of a ray's direction along an axis selects the corner by which it enters.
    corners: [[Vec4; 3]; 2],
    children: [Child; WIDTH],
}

/// Four triangles in structure-of-arrays layout: one corner, and the vectors from it to the other two.
struct Leaf {
    /// Indices of the triangles.
    triangles: [u32; WIDTH],
    corner: [Vec4; 3],
    right: [Vec4; 3],
    up: [Vec4; 3],
}

/// Content of a box: the index of a node, or the index of a leaf combined with [`LEAF`].
type Child = u32;
const LEAF: Child = 1 << 31;

/// A ray, prepared for tests against boxes.
struct Ray {
    origin: [Vec4; 3],
    direction: [Vec4; 3],
    inverse: [Vec4; 3],
    /// Index of the corner by which the ray enters, for each axis.
    enters: [usize; 3],
}

impl Bvh {
    /// Builds the tree: a binary one, converted to one with four boxes per node.
    pub fn new(triangles: &[Triangle]) -> Bvh {
        let settings = BvhBuildParams { max_prims_per_leaf: WIDTH as u32, ..BvhBuildParams::fast_build() };
        let tree = build_bvh2_from_tris(triangles, settings, &mut Duration::default());
        let mut bvh = Bvh::default();
        bvh.root = bvh.add_node(&tree, triangles, 0, 1);
        bvh
    }

    /// Adds node `index` of the binary tree, at depth `level`, with all below it.
    fn add_node(&mut self, tree: &Bvh2, triangles: &[Triangle], index: usize, level: usize) -> Child {
        assert!(level <= LEVELS, "triangles that no tree of {LEVELS} levels can sort");
        let Some(node) = tree.nodes.get(index) else { return self.add_leaf(&[], triangles) };
        let first = node.first_index as usize;
        if node.is_leaf() {
            return self.add_leaf(&tree.primitive_indices[first..][..node.prim_count as usize], triangles);
        }
        // Split the largest node until there are four.
        let mut open = vec![first, first + 1];
        let size = |index: &usize| tree.nodes[*index].aabb.half_area();
        while open.len() < WIDTH {
            let inner = (0..open.len()).filter(|&i| !tree.nodes[open[i]].is_leaf());
            let Some(largest) = inner.max_by(|&a, &b| size(&open[a]).total_cmp(&size(&open[b]))) else {
                break;
            };
            let children = tree.nodes[open[largest]].first_index as usize;
            open[largest] = children;
            open.push(children + 1);
        }
        // Empty boxes end before they begin, and no ray hits them.
        let mut boxes = [Aabb { min: Vec3A::splat(f32::MAX), max: Vec3A::splat(f32::MIN) }; WIDTH];
        for (aabb, &index) in boxes.iter_mut().zip(&open) {
            // Enlarge the boxes slightly to allow for rounding.
            let margin = Vec3A::splat(1e-4);
            let Aabb { min, max } = tree.nodes[index].aabb;
            *aabb = Aabb { min: min - margin, max: max + margin };
        }
        let corners = [boxes.map(|b| b.min), boxes.map(|b| b.max)].map(transposed);
        let number = self.nodes.len();
        self.nodes.push(Node { corners, children: [LEAF; WIDTH] });
        for (lane, &index) in open.iter().enumerate() {
            self.nodes[number].children[lane] = self.add_node(tree, triangles, index, level + 1);
        }
        number as Child
    }

    /// Adds a leaf of up to four of the `triangles`.
    fn add_leaf(&mut self, indices: &[u32], triangles: &[Triangle]) -> Child {
        // Missing triangles have no area, and no ray hits them.
        let nothing = Triangle { v0: Vec3A::ZERO, v1: Vec3A::ZERO, v2: Vec3A::ZERO };
        let mut leaf = ([u32::MAX; WIDTH], [nothing; WIDTH]);
        for (lane, &index) in indices.iter().enumerate() {
            (leaf.0[lane], leaf.1[lane]) = (index, triangles[index as usize]);
        }
        let along = |point: fn(&Triangle) -> Vec3A| transposed(leaf.1.each_ref().map(point));
        self.leaves.push(Leaf {
            triangles: leaf.0,
            corner: along(|t| t.v0),
            right: along(|t| t.v1 - t.v0),
            up: along(|t| t.v2 - t.v0),
        });
        LEAF | (self.leaves.len() - 1) as Child
    }

    /// Returns the first triangle along the ray from `origin` in `direction` (unit) that is nearer than `limit`.
    pub fn closest_hit(&self, origin: Vec3, direction: Vec3, limit: f32) -> Option<Hit> {
        self.traverse::<false>(origin, direction, limit)
    }

    /// Returns `true` if the ray hits any triangle before `limit`.
    pub fn is_occluded(&self, origin: Vec3, direction: Vec3, limit: f32) -> bool {
        self.traverse::<true>(origin, direction, limit).is_some()
    }

    /// Returns the first triangle along the ray before `limit`, or with `ANY` one that the ray hits before `limit`.
    fn traverse<const ANY: bool>(&self, origin: Vec3, direction: Vec3, limit: f32) -> Option<Hit> {
        let ray = Ray::new(origin, direction);
        let mut found = Hit { triangle: usize::MAX, distance: limit };
        let mut stack = [(0., self.root); STACK];
        let mut count = 1;
        while count > 0 {
            count -= 1;
            let (entered, child) = stack[count];
            if entered >= found.distance {
                continue;
            }
            if child & LEAF != 0 {
                let leaf = &self.leaves[(child ^ LEAF) as usize];
                let (distances, mask) = leaf.intersect(&ray, found.distance);
                for lane in lanes(mask) {
                    if distances[lane] < found.distance {
                        found = Hit { triangle: leaf.triangles[lane] as usize, distance: distances[lane] };
                    }
                }
                if ANY && mask != 0 {
                    break;
                }
                continue;
            }
            let node = &self.nodes[child as usize];
            let (entries, mask) = node.intersect(&ray, found.distance);
            let first = count;
            for lane in lanes(mask) {
                // Keep the stack sorted with the nearest box last, because it is popped first.
                let mut at = count;
                while !ANY && at > first && stack[at - 1].0 < entries[lane] {
                    stack[at] = stack[at - 1];
                    at -= 1;
                }
                stack[at] = (entries[lane], node.children[lane]);
                count += 1;
            }
        }
        (found.triangle != usize::MAX).then_some(found)
    }
}

/// Returns the indices of the set bits.
fn lanes(mut mask: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let lane = (mask != 0).then(|| mask.trailing_zeros() as usize)?;
        mask &= mask - 1;
        Some(lane)
    })
}

impl Ray {
    fn new(origin: Vec3, direction: Vec3) -> Self {
        // The inverse must stay finite: infinity times a distance of zero is NaN.
        let inverse = direction.map(|d| 1. / if d.abs() < 1e-20 { 1e-20f32.copysign(d) } else { d });
        let splat = |v: Vec3| v.to_array().map(Vec4::splat);
        let enters = direction.to_array().map(|d| usize::from(d.is_sign_negative()));
        Ray { origin: splat(origin), direction: splat(direction), inverse: splat(inverse), enters }
    }
}

impl Node {
    /// Returns the distances at which the ray enters the boxes, and a mask of the boxes that it hits before `limit`.
    #[inline(always)]
    fn intersect(&self, ray: &Ray, limit: f32) -> ([f32; WIDTH], u32) {
        let reach =
            |axis: usize, side: usize| (self.corners[side][axis] - ray.origin[axis]) * ray.inverse[axis];
        let [x, y, z] = ray.enters;
        let enters = reach(0, x).max(reach(1, y)).max(reach(2, z).max(Vec4::ZERO));
        let leaves = reach(0, 1 - x).min(reach(1, 1 - y)).min(reach(2, 1 - z).min(Vec4::splat(limit)));
        (enters.to_array(), enters.cmple(leaves).bitmask())
    }
}

impl Leaf {
    /// Returns the ray's distances to the triangles, and a mask of those that it hits before `limit` (Möller and Trumbore, 1997).
    /// Triangles include their edges, so that there is no gap between adjacent ones.
    #[inline(always)]
    fn intersect(&self, ray: &Ray, limit: f32) -> ([f32; WIDTH], u32) {
        let Leaf { corner, right, up, .. } = self;
        let normal = cross(right, up);
        let scale = Vec4::ONE / dot(&normal, &ray.direction);
        let way: [Vec4; 3] = std::array::from_fn(|axis| corner[axis] - ray.origin[axis]);
        let across = cross(&way, &ray.direction);
        let (u, v) = (scale * dot(up, &across), -scale * dot(right, &across));
        let distance = scale * dot(&normal, &way);
        // NaN also gives `false`: the ray is parallel to the triangle, or the lane is empty.
        let inside = u.cmpge(Vec4::ZERO) & v.cmpge(Vec4::ZERO) & (u + v).cmple(Vec4::ONE);
        let mask = inside & distance.cmpge(Vec4::ZERO) & distance.cmplt(Vec4::splat(limit));
        (distance.to_array(), mask.bitmask())
    }
}

#[inline(always)]
fn cross(a: &[Vec4; 3], b: &[Vec4; 3]) -> [Vec4; 3] {
    [a[1] * b[2] - b[1] * a[2], a[2] * b[0] - b[2] * a[0], a[0] * b[1] - b[0] * a[1]]
}

#[inline(always)]
fn dot(a: &[Vec4; 3], b: &[Vec4; 3]) -> Vec4 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Returns the x, y and z coordinates of all points.
fn transposed(points: [Vec3A; WIDTH]) -> [Vec4; 3] {
    std::array::from_fn(|axis| Vec4::from_array(points.map(|point| point[axis])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// The tree finds the same nearest hits as a search over all triangles. The triangles are random, some of them large and some flat
    /// along an axis. The rays are random, too, some of them along an axis.
    #[test]
    fn nearest_hit_matches_brute_force() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        for count in [0, 1, 2, 3, 5, 17, 900] {
            let triangles: Vec<Triangle> = (0..count)
                .map(|i| {
                    let mut vector =
                        |size: f32| Vec3A::from_array([(); 3].map(|()| random.random_range(-size..size)));
                    let (v0, size) = (vector(10.), if i % 7 == 0 { 8. } else { 0.6 });
                    let [mut v1, mut v2] = [v0 + vector(size), v0 + vector(size)];
                    if i % 3 == 0 {
                        (v1[i % 9 / 3], v2[i % 9 / 3]) = (v0[i % 9 / 3], v0[i % 9 / 3]);
                    }
                    Triangle { v0, v1, v2 }
                })
                .collect();
            let bvh = Bvh::new(&triangles);
            let filled = bvh.leaves.iter().flat_map(|leaf| leaf.triangles).filter(|&index| index != u32::MAX);
            let mut known: Vec<usize> = filled.map(|index| index as usize).collect();
            known.sort();
            assert!(known.into_iter().eq(0..count), "every triangle is in a leaf");
            let mut hits = 0;
            for i in 0..4000 {
                let mut vector =
                    |size: f32| Vec3::from_array([(); 3].map(|()| random.random_range(-size..size)));
                let (origin, mut direction) = (vector(14.), vector(1.).normalize());
                if i % 5 == 0 {
                    direction = Vec3::AXES[i % 3] * [1., -1.][i / 5 % 2];
                }
                let limit = if i % 2 == 0 { f32::INFINITY } else { 6. };
                let ray = Ray::new(origin, direction);
                let nearest = bvh.leaves.iter().flat_map(|leaf| {
                    let (distances, mask) = leaf.intersect(&ray, limit);
                    lanes(mask).map(move |lane| distances[lane])
                });
                let nearest = nearest.min_by(f32::total_cmp);
                let found = bvh.closest_hit(origin, direction, limit);
                let distance = found.map(|hit| hit.distance);
                assert_eq!(distance, nearest, "{count} triangles, from {origin} along {direction}");
                assert_eq!(bvh.is_occluded(origin, direction, limit), nearest.is_some());
                if let Some(hit) = found {
                    hits += 1;
                    let Triangle { v0, v1, v2 } = triangles[hit.triangle];
                    let (point, normal) =
                        (Vec3A::from(origin + hit.distance * direction), (v1 - v0).cross(v2 - v0));
                    assert!((point - v0).dot(normal.normalize()).abs() < 1e-3, "it isn't there");
                }
            }
            assert!(hits > 1000 || count < 900, "{hits} of 4000 rays meet one of {count} triangles");
        }
    }

    /// A fan of triangles around a point, seen along every edge, has no gaps.
    #[test]
    fn triangles_of_a_fan_have_no_gaps() {
        let center = Vec3A::new(0., 0.3, 0.);
        let point = |i: usize| {
            let (sin, cos) = (i as f32 / 12. * std::f32::consts::TAU).sin_cos();
            Vec3A::new(cos, 0.3, sin)
        };
        let fan = |i| Triangle { v0: center, v1: point(i), v2: point(i + 1) };
        let bvh = Bvh::new(&(0..12).map(fan).collect::<Vec<_>>());
        for i in 0..12 * 50 {
            let at = center.lerp(point(i / 50), (i % 50) as f32 / 51.);
            let origin = Vec3::from(at) + Vec3::Y;
            assert!(bvh.is_occluded(origin, Vec3::NEG_Y, 1.1), "a gap at {at}");
            let hit = bvh.closest_hit(origin, Vec3::NEG_Y, 9.).expect("a triangle");
            assert!((hit.distance - 1.).abs() < 1e-5);
        }
    }
}
