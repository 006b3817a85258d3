//! Finds the triangle that a ray hits.

use glam::Vec3;
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::cwbvh::CwBvh;
use obvhs::cwbvh::builder::build_cwbvh;
use obvhs::ray::{Ray, RayHit};
use obvhs::triangle::Triangle;
use std::time::Duration;

/// Bounding volume hierarchy of triangles.
pub(super) struct Bvh {
    tree: CwBvh,
    /// Triangles in the order of the tree.
    triangles: Vec<Triangle>,
}

/// Intersection of a ray with a triangle.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hit {
    /// Index of the triangle.
    pub triangle: usize,
    pub distance: f32,
}

impl Bvh {
    pub fn new(triangles: &[Triangle]) -> Bvh {
        let boxes: Vec<Aabb> = triangles.iter().map(enlarged_box).collect();
        let tree = build_cwbvh(&boxes, BvhBuildParams::fast_build(), &mut Duration::default());
        let triangles = tree.primitive_indices.iter().map(|&index| triangles[index as usize]).collect();
        Bvh { tree, triangles }
    }

    /// Returns the first triangle along the ray from `origin` in `direction` (unit) that is nearer than `limit`.
    pub fn closest_hit(&self, origin: Vec3, direction: Vec3, limit: f32) -> Option<Hit> {
        let (ray, mut hit) = (prepared_ray(origin, direction, limit), RayHit::none());
        let is_hit =
            self.tree.ray_traverse(ray, &mut hit, |ray, index| distance(&self.triangles[index], ray));
        let triangle = || self.tree.primitive_indices[hit.primitive_id as usize] as usize;
        is_hit.then(|| Hit { triangle: triangle(), distance: hit.t })
    }

    /// Returns `true` if the ray hits any triangle before `limit`.
    pub fn is_occluded(&self, origin: Vec3, direction: Vec3, limit: f32) -> bool {
        let mut state = self.tree.new_ray_traversal(prepared_ray(origin, direction, limit));
        self.tree.ray_traverse_dynamic(&mut state, &mut RayHit::none(), |ray, index| {
            distance(&self.triangles[index], ray)
        })
    }
}

fn prepared_ray(origin: Vec3, direction: Vec3, limit: f32) -> Ray {
    // The tree takes -0 for positive in one place and for negative in another. The sum is never -0.
    Ray::new(origin.into(), (direction + 0.).into(), 0., limit)
}

/// Returns the triangle's bounding box, slightly enlarged to allow for rounding.
fn enlarged_box(triangle: &Triangle) -> Aabb {
    let Aabb { min, max } = triangle.aabb();
    Aabb { min: min - 1e-4, max: max + 1e-4 }
}

/// Returns the distance at which the ray hits the triangle, or infinity (Möller and Trumbore, 1997). A triangle includes its edges, unlike
/// in `Triangle::intersect`, so that there is no gap between adjacent ones.
fn distance(triangle: &Triangle, ray: &Ray) -> f32 {
    let (right, up) = (triangle.v1 - triangle.v0, triangle.v2 - triangle.v0);
    let normal = right.cross(up);
    let scale = 1. / normal.dot(ray.direction);
    let way = triangle.v0 - ray.origin;
    let across = way.cross(ray.direction);
    let (u, v) = (scale * up.dot(across), -scale * right.dot(across));
    let distance = scale * normal.dot(way);
    // NaN also gives `false`: the ray is parallel to the triangle.
    let is_hit = u >= 0. && v >= 0. && u + v <= 1. && (0. ..ray.tmax).contains(&distance);
    if is_hit { distance } else { f32::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3A;
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
            let mut hits = 0;
            for i in 0..4000 {
                let mut vector =
                    |size: f32| Vec3::from_array([(); 3].map(|()| random.random_range(-size..size)));
                let (origin, mut direction) = (vector(14.), vector(1.).normalize());
                if i % 5 == 0 {
                    direction = Vec3::AXES[i % 3] * [1., -1.][i / 5 % 2];
                }
                let limit = if i % 2 == 0 { f32::INFINITY } else { 6. };
                let ray = prepared_ray(origin, direction, limit);
                let nearest =
                    triangles.iter().map(|triangle| distance(triangle, &ray)).filter(|&t| t < limit);
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
