//! Ray tracing of triangles.

use super::bvh::{Bvh, Hit};
use super::light::{Light, Material, Sky};
use super::mesh::Mesh;
use glam::{Vec2, Vec3, Vec3A};
use obvhs::triangle::Triangle;
use rayon::prelude::*;
use std::f32::consts::{PI, TAU};

/// Number of directions in which a vertex gathers light from other surfaces.
const GATHER_DIRECTIONS: usize = 24;
/// Angular width of these rays in radians, for the blur of textures: about the angle between neighbouring directions around the normal,
/// √(π / 24) = 0.36.
const GATHER_SPREAD: f32 = 0.3;
/// Offset of the start of a ray from the surface that it leaves, in metres.
const RAY_OFFSET: f32 = 1e-3;

/// Meshes with their materials, and the light sources.
#[derive(Default)]
pub(super) struct SceneContents {
    pub meshes: Vec<(Mesh, Material)>,
    pub lights: Vec<Light>,
}

/// A scene prepared for ray tracing.
pub(super) struct Tracer {
    bvh: Bvh,
    faces: Vec<Face>,
    normals: Vec<Vec3>,
    uvs: Vec<Vec2>,
    /// Indirect irradiance at each vertex, divided by π: light from the sky, and light reflected by one other surface.
    indirect: Vec<Vec3>,
    materials: Vec<Material>,
    lights: Vec<Light>,
    sky: Sky,
}

/// A triangle, the indices of its vertices, and its material.
#[derive(Clone, Copy)]
struct Face {
    triangle: Triangle,
    vertices: [u32; 3],
    material: u32,
}

/// Intersection of a ray with a surface.
struct SurfaceHit<'a> {
    point: Vec3,
    /// Interpolated normal, facing against the ray.
    normal: Vec3,
    /// Normal of the triangle, facing against the ray.
    geometric_normal: Vec3,
    /// Diffuse reflectance.
    reflectance: Vec3,
    indirect: Vec3,
    material: &'a Material,
}

/// Random choices of one sample of a pixel, besides its ray.
#[derive(Debug, Clone, Copy)]
pub(super) struct SampleChoice {
    /// Index of the sample; sample i uses light source i modulo the number of lights.
    pub sample_index: usize,
    /// Position on the light source, in [0, 1)².
    pub on_light: Vec2,
}

impl Tracer {
    /// Builds the tree and gathers indirect light on all threads. The latter takes most of the time. The scene may be empty.
    pub fn new(contents: SceneContents, sky: Sky) -> Tracer {
        let mut whole = Mesh::default();
        let (mut owners, mut materials, mut normals) = (vec![], vec![], vec![]);
        for (mesh, material) in contents.meshes {
            owners.extend(mesh.triangles.iter().map(|_| materials.len() as u32));
            normals.extend(mesh.normals());
            whole.join(mesh);
            materials.push(material);
        }
        let position = |vertex: u32| Vec3A::from(whole.positions[vertex as usize]);
        let face = |(&vertices, &material): (&[u32; 3], &u32)| {
            let [v0, v1, v2] = vertices.map(position);
            Face { triangle: Triangle { v0, v1, v2 }, vertices, material }
        };
        let faces: Vec<Face> = whole.triangles.iter().zip(&owners).map(face).collect();
        let triangles: Vec<Triangle> = faces.iter().map(|face| face.triangle).collect();
        let bvh = Bvh::new(&triangles);
        let inset_vertices = whole.inset_vertices();
        let uvs = whole.uvs;
        let (lights, indirect) = (balance_lights(contents.lights), vec![]);
        let mut tracer = Tracer { bvh, faces, normals, uvs, indirect, materials, lights, sky };
        tracer.indirect = tracer.gather_indirect(&inset_vertices);
        tracer
    }

    /// Returns the radiance that arrives at `origin` along a ray in `direction` (unit), for a pixel `spread` radians wide.
    pub fn trace(&self, origin: Vec3, direction: Vec3, spread: f32, choice: SampleChoice) -> Vec3 {
        let Some(hit) = self.bvh.closest_hit(origin, direction, f32::INFINITY) else {
            return self.sky.radiance(direction);
        };
        let surface = self.surface(origin, direction, hit, spread);
        let (direct, highlight) = self.sample_direct_light(&surface, direction, choice);
        surface.reflectance * (surface.indirect + direct + surface.material.emission) + highlight
    }

    /// Returns the distance to the nearest surface in `direction` (unit), at most `limit`.
    pub fn free_distance(&self, origin: Vec3, direction: Vec3, limit: f32) -> f32 {
        self.bvh.closest_hit(origin, direction, limit).map_or(limit, |hit| hit.distance)
    }

    /// Estimates the direct light with one light source, number `choice.sample_index` modulo the number of lights, scaled by the number
    /// of lights. Returns the diffuse irradiance divided by π, and the radiance of the highlight, both linear RGB. `direction` is the unit
    /// direction of the viewing ray.
    fn sample_direct_light(
        &self,
        surface: &SurfaceHit,
        direction: Vec3,
        choice: SampleChoice,
    ) -> (Vec3, Vec3) {
        if self.lights.is_empty() {
            return (Vec3::ZERO, Vec3::ZERO);
        }
        let source = &self.lights[choice.sample_index % self.lights.len()];
        let light = source.incident_at(surface.point, choice.on_light);
        let facing = light.towards.dot(surface.normal);
        let is_behind = facing <= 0. || light.towards.dot(surface.geometric_normal) <= 0.;
        if is_behind || light.color.max_element() < 1e-4 {
            return (Vec3::ZERO, Vec3::ZERO);
        }
        let start = surface.point + RAY_OFFSET * surface.geometric_normal;
        if self.bvh.is_occluded(start, light.towards, light.distance - 2. * RAY_OFFSET) {
            return (Vec3::ZERO, Vec3::ZERO);
        }
        let color = self.lights.len() as f32 * light.color;
        let Material { specular, shininess, .. } = *surface.material;
        let highlight = if specular > 0. {
            // Normalized Blinn–Phong lobe.
            let half = (light.towards - direction).normalize_or(surface.normal);
            let lobe = (shininess + 8.) / (8. * PI) * half.dot(surface.normal).max(0.).powf(shininess);
            specular * lobe * facing * color
        } else {
            Vec3::ZERO
        };
        (color * facing / PI, highlight)
    }

    fn surface(&self, origin: Vec3, direction: Vec3, hit: Hit, spread: f32) -> SurfaceHit<'_> {
        let Face { triangle: Triangle { v0, v1, v2 }, vertices, material } = self.faces[hit.triangle];
        let [a, b, c] = vertices.map(|vertex| vertex as usize);
        let point = origin + hit.distance * direction;
        let cross = Vec3::from((v1 - v0).cross(v2 - v0));
        let cross_squared = cross.length_squared();
        // Barycentric coordinates of b and c.
        let from_a = Vec3A::from(point) - v0;
        let s = Vec3::from(from_a.cross(v2 - v0)).dot(cross) / cross_squared;
        let t = Vec3::from((v1 - v0).cross(from_a)).dot(cross) / cross_squared;
        let mut geometric_normal = cross / cross_squared.sqrt();
        if geometric_normal.dot(direction) > 0. {
            geometric_normal = -geometric_normal;
        }
        let interpolate = |[x, y, z]: [Vec3; 3]| x + s * (y - x) + t * (z - x);
        let at_corners = |values: &[Vec3]| [a, b, c].map(|vertex| values[vertex]);
        let mut normal = interpolate(at_corners(&self.normals)).normalize_or(geometric_normal);
        if normal.dot(geometric_normal) < 0. {
            normal = -normal;
        }
        let uv = self.uvs[a] + s * (self.uvs[b] - self.uvs[a]) + t * (self.uvs[c] - self.uvs[a]);
        let material = &self.materials[material as usize];
        let slant = (-direction.dot(geometric_normal)).max(0.1);
        let reflectance = material.reflectance(uv, hit.distance * spread / slant.sqrt());
        // Empty while the indirect light itself is gathered.
        let indirect =
            if self.indirect.is_empty() { Vec3::ZERO } else { interpolate(at_corners(&self.indirect)) };
        SurfaceHit { point, normal, geometric_normal, reflectance, indirect, material }
    }

    /// Gathers light from the sky and from one other surface at every vertex, starting at the points `inset_vertices`. Using the same
    /// directions around each normal makes the errors smooth.
    fn gather_indirect(&self, inset_vertices: &[Vec3]) -> Vec<Vec3> {
        let directions: Vec<Vec3> = (0..GATHER_DIRECTIONS)
            .map(|i| {
                // Cosine-weighted directions, on a spiral.
                let height = (1. - (i as f32 + 0.5) / GATHER_DIRECTIONS as f32).sqrt();
                let angle = TAU * 0.618_034 * i as f32;
                let ring = (1. - height * height).sqrt();
                Vec3::new(ring * angle.cos(), ring * angle.sin(), height)
            })
            .collect();
        let gather = |(&inside, &normal): (&Vec3, &Vec3)| {
            let (right, up) = normal.any_orthonormal_pair();
            let start = inside + 5. * RAY_OFFSET * normal;
            let contribution = |(i, d): (usize, &Vec3)| {
                let direction = d.x * right + d.y * up + d.z * normal;
                let Some(hit) = self.bvh.closest_hit(start, direction, f32::INFINITY) else {
                    return self.sky.mean_radiance(direction);
                };
                let surface = self.surface(start, direction, hit, GATHER_SPREAD);
                let choice = SampleChoice { sample_index: i, on_light: Vec2::splat(0.5) };
                let (direct, _) = self.sample_direct_light(&surface, direction, choice);
                // Approximate further bounces by a share of the sky's light.
                let rest = 0.12 * self.sky.mean_radiance(surface.normal);
                surface.reflectance * (direct + surface.material.emission + rest)
            };
            directions.iter().enumerate().map(contribution).sum::<Vec3>() / GATHER_DIRECTIONS as f32
        };
        inset_vertices.par_iter().zip(&self.normals).map(gather).collect()
    }
}

/// Returns one, two or four lights (or none), so that the four samples of a pixel use each equally often. Three become four: the third
/// is split into two of half intensity. Lights beyond the fourth are dropped.
fn balance_lights(mut lights: Vec<Light>) -> Vec<Light> {
    lights.truncate(4);
    if lights.len() == 3 {
        lights[2].color *= 0.5;
        lights.push(lights[2]);
    }
    lights
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::LightSource;
    use crate::mesh::superellipsoid;
    use crate::noise::Noise;
    use crate::texture::Texture;
    use std::sync::Arc;

    const DARK: Sky =
        Sky { zenith: Vec3::ZERO, horizon: Vec3::ZERO, ground: Vec3::ZERO, clouds: 0., noise: Noise::new(0) };
    const CENTER: SampleChoice = SampleChoice { sample_index: 0, on_light: Vec2::splat(0.5) };

    fn sun(towards: Vec3, brightness: f32) -> Light {
        Light { color: Vec3::splat(brightness), source: LightSource::Sun { towards, spread: 0. } }
    }

    /// Returns a scene under `sky` with a floor of the given reflectance, five metres in each direction, and anything that `more` adds.
    fn floor_scene(sky: Sky, reflectance: f32, more: impl FnOnce(&mut SceneContents, &Material)) -> Tracer {
        let material = Material::matte(Arc::new(Texture::uniform(Vec3::splat(reflectance))));
        let mut contents = SceneContents::default();
        let floor = Mesh::rectangle(Vec3::new(-5., 0., 5.), Vec3::X * 10., Vec3::Z * -10., 1.);
        contents.meshes.push((floor, material.clone()));
        more(&mut contents, &material);
        Tracer::new(contents, sky)
    }

    /// Returns the radiance of the floor at (`x`, `z`), seen from above, as the mean of the four samples of a pixel.
    fn radiance_at(tracer: &Tracer, x: f32, z: f32) -> f32 {
        let at = Vec3::new(x, 0., z);
        let eye = at + Vec3::new(0.5, 3., 0.5);
        let trace = |sample_index| {
            tracer.trace(eye, (at - eye).normalize(), 1e-3, SampleChoice { sample_index, ..CENTER }).x
        };
        (0..4).map(trace).sum::<f32>() / 4.
    }

    /// Radiance follows Lambert's law: reflectance · irradiance · cos / π, whatever the number of lights. Under a uniform sky, a surface
    /// is as bright as the sky times its reflectance.
    #[test]
    fn matte_floors_reflect_suns_and_the_sky() {
        for lights in 1..=4 {
            let towards = |i: i32| Vec3::new(0.1 * i as f32, 1., 0.).normalize();
            let tracer = floor_scene(DARK, 0.5, |contents, _| {
                contents.lights.extend((0..lights).map(|i| sun(towards(i), 2.)));
            });
            let expected = 0.5 * 2. * (0..lights).map(|i| towards(i).y).sum::<f32>() / PI;
            let found = radiance_at(&tracer, 0.3, 0.2);
            assert!((found / expected - 1.).abs() < 0.02, "{lights} lights: {found}, expected {expected}");
        }
        let light = Vec3::splat(0.7);
        for reflectance in [0.1, 0.5] {
            let sky = Sky { zenith: light, horizon: light, ground: light, ..DARK };
            let found = radiance_at(&floor_scene(sky, reflectance, |_, _| {}), 0.3, 0.2);
            assert!((found / (0.7 * reflectance) - 1.).abs() < 0.02, "{reflectance}: {found}");
        }
    }

    #[test]
    fn light_falls_with_distance_and_angle() {
        let center = Vec3::new(0., 2., 0.);
        let panel = LightSource::Panel { center, right: Vec3::ZERO, up: Vec3::ZERO, facing: Vec3::NEG_Y };
        for (source, expected) in [
            // Twice the squared distance, and the cosine of the angle.
            (LightSource::Ball { center, radius: 0. }, 2. * 2f32.sqrt()),
            // Also the cosine of the angle at which light leaves the panel.
            (panel, 4.),
        ] {
            let light = Light { color: Vec3::ONE, source };
            let tracer = floor_scene(DARK, 0.9, |contents, _| contents.lights.push(light));
            let ratio = radiance_at(&tracer, 0.02, 0.01) / radiance_at(&tracer, 2., 0.01);
            assert!((ratio / expected - 1.).abs() < 0.0175, "{source:?}: {ratio}");
        }
    }

    /// Highlights follow the Blinn–Phong lobe, for an eye in the mirror direction of the sun.
    #[test]
    fn glossy_things_have_highlights() {
        let towards = Vec3::new(1., 1., 0.).normalize();
        let trace = |specular: f32, eye: Vec3| {
            let tracer = floor_scene(DARK, 0.02, |contents, material| {
                contents.lights.push(sun(towards, 2.));
                let sheet = Mesh::rectangle(Vec3::new(-1., 0.5, 1.), 2. * Vec3::X, -2. * Vec3::Z, 1.);
                contents.meshes.push((sheet, Material { specular, shininess: 30., ..material.clone() }));
            });
            tracer.trace(Vec3::new(0.1, 0.5, 0.2) + eye, -eye.normalize(), 1e-3, CENTER).x
        };
        let mirrored = Vec3::new(-1., 1., 0.);
        let expected = 0.5 * 38. / (8. * PI) * towards.y * 2.;
        let found = trace(0.5, mirrored) - trace(0., mirrored);
        assert!((found / expected - 1.).abs() < 0.02, "{found}, expected {expected}");
        assert!(trace(0.5, Vec3::new(1., 1., 0.)) < 0.1 * found, "seen from the sun");
    }

    #[test]
    fn objects_cast_shadows_and_receive_bounced_light() {
        let tracer = floor_scene(DARK, 0.5, |contents, material| {
            contents.lights.push(sun(Vec3::Y, 3.));
            let ball = superellipsoid(Vec3::ONE, [1., 1.], 16).warped(|p| p + 1.5 * Vec3::Y);
            contents.meshes.push((ball, material.clone()));
        });
        let (shadow, lit) = (radiance_at(&tracer, 0.1, 0.1), radiance_at(&tracer, 2., 2.));
        assert!(shadow < 0.3 * lit, "{shadow} {lit}");
        // The lower side of the ball is lit by the floor alone.
        let below = tracer.trace(Vec3::new(0., 0.2, 0.), Vec3::Y, 1e-3, CENTER).x;
        assert!(below > 0.1 * lit && below < lit, "{below} {lit}");
    }

    #[test]
    fn free_distance_ends_at_surfaces() {
        let tracer = floor_scene(DARK, 0.2, |_, _| {});
        assert!((tracer.free_distance(Vec3::new(0.2, 3., 0.1), Vec3::NEG_Y, 10.) - 3.).abs() < 1e-5);
        for limit in [7., f32::INFINITY] {
            assert_eq!(tracer.free_distance(Vec3::Y, Vec3::Y, limit), limit);
        }
    }

    #[test]
    fn an_empty_scene_shows_the_sky() {
        let sky = Sky { zenith: Vec3::ONE, horizon: Vec3::ONE, ..DARK };
        let tracer = Tracer::new(SceneContents::default(), sky);
        assert_eq!(tracer.trace(Vec3::ZERO, Vec3::Y, 1e-3, CENTER), Vec3::ONE);
    }
}
