//! Ray tracing of triangles.

use super::bvh::{Bvh, Hit};
use super::light::{Light, Sky};
use super::material::Material;
use super::mesh::Mesh;
use glam::{Vec2, Vec3, Vec3A};
use obvhs::triangle::Triangle;
use rayon::prelude::*;
use std::f32::consts::{PI, TAU};

/// Number of directions in which a vertex gathers light from other surfaces.
const GATHER_DIRECTIONS: usize = 24;
/// Offset of the start of a ray from the surface that it leaves, in metres.
const RAY_OFFSET: f32 = 1e-3;
/// Maximum number of mirror reflections along a ray.
const MAX_REFLECTIONS: u32 = 3;

/// Meshes with their materials, and the light sources.
#[derive(Default)]
pub(super) struct SceneContents {
    pub meshes: Vec<(Mesh, Material)>,
    pub lights: Vec<Light>,
}

/// A scene prepared for ray tracing.
pub(super) struct Tracer {
    bvh: Bvh,
    /// Number of triangles.
    triangles: usize,
    /// Faces ordered by their positions in the tree, so that neighbours in space are neighbours in memory.
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
struct Surface<'a> {
    point: Vec3,
    /// Interpolated normal, facing against the ray.
    normal: Vec3,
    /// Normal of the triangle, facing against the ray.
    flat: Vec3,
    reflectance: Vec3,
    indirect: Vec3,
    material: &'a Material,
}

/// Random choices of one sample of a pixel, besides its ray.
#[derive(Debug, Clone, Copy)]
pub(super) struct SampleChoice {
    /// Index of the sampled light source. The four samples of a pixel take turns.
    pub turn: usize,
    /// Position on the light source, in [0, 1)².
    pub on_light: Vec2,
}

impl Tracer {
    /// Builds the tree and gathers indirect light on all threads. The latter takes most of the time.
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
        let (bvh, places) = Bvh::new(&triangles);
        // Positions without a triangle, which no ray hits, get an arbitrary face.
        let faces = places.iter().map(|slot| faces[slot.unwrap_or(0)]).collect();
        let inset_vertices = whole.inset_vertices();
        let uvs = whole.uvs;
        let (lights, indirect, triangles) = (balance_lights(contents.lights), vec![], triangles.len());
        let mut tracer = Tracer { bvh, triangles, faces, normals, uvs, indirect, materials, lights, sky };
        tracer.indirect = tracer.gather_indirect(&inset_vertices);
        tracer
    }

    /// Returns the radiance that arrives at `origin` from `towards` (unit), for a pixel `spread` radians wide.
    pub fn trace(&self, origin: Vec3, towards: Vec3, spread: f32, choice: SampleChoice) -> Vec3 {
        self.radiance(origin, towards, spread, choice, MAX_REFLECTIONS)
    }

    /// Returns the distance to the nearest surface in the direction `towards`, at most `limit`.
    pub fn free_distance(&self, origin: Vec3, towards: Vec3, limit: f32) -> f32 {
        self.bvh.closest_hit(origin, towards, limit).map_or(limit, |hit| hit.distance)
    }

    pub fn triangles(&self) -> usize {
        self.triangles
    }

    fn radiance(&self, origin: Vec3, towards: Vec3, spread: f32, choice: SampleChoice, depth: u32) -> Vec3 {
        let Some(hit) = self.bvh.closest_hit(origin, towards, f32::INFINITY) else {
            return self.sky.radiance(towards);
        };
        let surface = self.surface(origin, towards, hit, spread);
        let material = surface.material;
        let (direct, highlight) = self.direct(&surface, towards, choice);
        let mut radiance = surface.reflectance * (surface.indirect + direct + material.glow) + highlight;
        // Schlick's approximation: surfaces reflect more at grazing angles.
        let flatness = 1. + towards.dot(surface.normal);
        let mirror = material.mirror + (1. - material.mirror) * material.mirror.sqrt() * flatness.powi(5);
        if mirror > 0.02 && depth > 0 {
            let away = towards - 2. * towards.dot(surface.normal) * surface.normal;
            let start = surface.point + RAY_OFFSET * surface.flat;
            let mirrored = self.radiance(start, away, 2. * spread, choice, depth - 1);
            radiance = radiance.lerp(mirrored, mirror);
        }
        radiance
    }

    /// Returns the irradiance, divided by π, from the light source whose turn it is, times the number of lights, and its highlight.
    fn direct(&self, surface: &Surface, towards: Vec3, choice: SampleChoice) -> (Vec3, Vec3) {
        if self.lights.is_empty() {
            return (Vec3::ZERO, Vec3::ZERO);
        }
        let light = self.lights[choice.turn % self.lights.len()].incident_at(surface.point, choice.on_light);
        let facing = light.towards.dot(surface.normal);
        if facing <= 0. || light.towards.dot(surface.flat) <= 0. || light.colour.max_element() < 1e-4 {
            return (Vec3::ZERO, Vec3::ZERO);
        }
        let start = surface.point + RAY_OFFSET * surface.flat;
        if self.bvh.is_occluded(start, light.towards, light.distance - 2. * RAY_OFFSET) {
            return (Vec3::ZERO, Vec3::ZERO);
        }
        let colour = self.lights.len() as f32 * light.colour;
        let Material { gloss, polish, .. } = *surface.material;
        let highlight = if gloss > 0. {
            // Normalized Blinn–Phong lobe.
            let half = (light.towards - towards).normalize_or(surface.normal);
            let lobe = (polish + 8.) / (8. * PI) * half.dot(surface.normal).max(0.).powf(polish);
            gloss * lobe * facing * colour
        } else {
            Vec3::ZERO
        };
        (colour * facing / PI, highlight)
    }

    fn surface(&self, origin: Vec3, towards: Vec3, hit: Hit, spread: f32) -> Surface<'_> {
        let Face { triangle: Triangle { v0, v1, v2 }, vertices, material } = self.faces[hit.slot];
        let [a, b, c] = vertices.map(|vertex| vertex as usize);
        let point = origin + hit.distance * towards;
        let cross = Vec3::from((v1 - v0).cross(v2 - v0));
        let area = cross.length_squared();
        // Barycentric coordinates of b and c.
        let from_a = Vec3A::from(point) - v0;
        let s = Vec3::from(from_a.cross(v2 - v0)).dot(cross) / area;
        let t = Vec3::from((v1 - v0).cross(from_a)).dot(cross) / area;
        let mut flat = cross / area.sqrt();
        if flat.dot(towards) > 0. {
            flat = -flat;
        }
        let mean = |[x, y, z]: [Vec3; 3]| x + s * (y - x) + t * (z - x);
        let mut normal = mean([self.normals[a], self.normals[b], self.normals[c]]).normalize_or(flat);
        if normal.dot(flat) < 0. {
            normal = -normal;
        }
        let uv = self.uvs[a] + s * (self.uvs[b] - self.uvs[a]) + t * (self.uvs[c] - self.uvs[a]);
        let material = &self.materials[material as usize];
        let slant = (-towards.dot(flat)).max(0.1);
        let reflectance = material.reflectance(uv, hit.distance * spread / slant.sqrt());
        let indirect = if self.indirect.is_empty() {
            Vec3::ZERO
        } else {
            mean([self.indirect[a], self.indirect[b], self.indirect[c]])
        };
        Surface { point, normal, flat, reflectance, indirect, material }
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
                let towards = d.x * right + d.y * up + d.z * normal;
                let Some(hit) = self.bvh.closest_hit(start, towards, f32::INFINITY) else {
                    return self.sky.mean_radiance(towards);
                };
                let surface = self.surface(start, towards, hit, 0.3);
                let choice = SampleChoice { turn: i, on_light: Vec2::splat(0.5) };
                let (direct, _) = self.direct(&surface, towards, choice);
                // Approximate further bounces by a share of the sky's light.
                let rest = 0.12 * self.sky.mean_radiance(surface.normal);
                surface.reflectance * (direct + surface.material.glow + rest)
            };
            directions.iter().enumerate().map(contribution).sum::<Vec3>() / GATHER_DIRECTIONS as f32
        };
        inset_vertices.par_iter().zip(&self.normals).map(gather).collect()
    }
}

/// Reduces the lights to one, two or four, which the four samples of a pixel use equally often. The third of three lights becomes two
/// with half its light. Lights beyond the fourth are dropped.
fn balance_lights(mut lights: Vec<Light>) -> Vec<Light> {
    lights.truncate(4);
    if lights.len() == 3 {
        let half = lights[2].dimmed(0.5);
        lights[2] = half;
        lights.push(half);
    }
    lights
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::noise::Noise;
    use crate::shapes::superellipsoid;
    use crate::texture::Texture;
    use std::sync::Arc;

    const DARK: Sky =
        Sky { zenith: Vec3::ZERO, horizon: Vec3::ZERO, ground: Vec3::ZERO, clouds: 0., noise: Noise::new(0) };

    /// Returns a scene with a floor of reflectance `grey`, five metres in each direction, and anything that `more` adds.
    fn world(grey: u8, more: impl FnOnce(&mut SceneContents, &Material)) -> Tracer {
        under(DARK, grey, more)
    }

    /// Returns a scene like [`world`], under a sky.
    fn under(sky: Sky, grey: u8, more: impl FnOnce(&mut SceneContents, &Material)) -> Tracer {
        let texture =
            Arc::new(Texture::from_image(&image::RgbImage::from_pixel(4, 4, image::Rgb([grey; 3]))));
        let material = Material::matte(texture);
        let mut contents = SceneContents::default();
        let floor = Mesh::rectangle(Vec3::new(-5., 0., 5.), Vec3::X * 10., Vec3::Z * -10., 1.);
        contents.meshes.push((floor, material.clone()));
        more(&mut contents, &material);
        Tracer::new(contents, sky)
    }

    fn seen(tracer: &Tracer, at: Vec3) -> f32 {
        let choice = |turn| SampleChoice { turn, on_light: Vec2::splat(0.5) };
        let eye = at + Vec3::new(0.5, 3., 0.5);
        let trace = |turn| tracer.trace(eye, (at - eye).normalize(), 1e-3, choice(turn)).x;
        (0..4).map(trace).sum::<f32>() / 4.
    }

    /// Returns the linear reflectance of an sRGB byte.
    fn reflectance(grey: u8) -> f32 {
        ((f32::from(grey) / 255. + 0.055) / 1.055).powf(2.4)
    }

    /// Radiance follows Lambert's law: reflectance · irradiance · cos / π, whatever the number of lights.
    #[test]
    fn matte_floors_follow_lamberts_law() {
        for lights in 1..=4 {
            let tracer = world(186, |contents, _| {
                for i in 0..lights {
                    let towards = Vec3::new(0.1 * i as f32, 1., 0.).normalize();
                    contents.lights.push(Light::Sun { towards, spread: 0., colour: Vec3::splat(2.) });
                }
            });
            let cosines: f32 = (0..lights).map(|i| Vec3::new(0.1 * i as f32, 1., 0.).normalize().y).sum();
            let expected = reflectance(186) * 2. * cosines / PI;
            let found = seen(&tracer, Vec3::new(0.3, 0., 0.2));
            assert!((found / expected - 1.).abs() < 0.02, "{lights} lights: {found}, expected {expected}");
        }
    }

    #[test]
    fn light_of_a_ball_falls_with_the_square_of_the_distance() {
        let tracer = world(255, |contents, _| {
            contents.lights.push(Light::Ball { at: Vec3::new(0., 2., 0.), radius: 0., colour: Vec3::ONE });
        });
        let (below, aside) =
            (seen(&tracer, Vec3::new(0.02, 0., 0.01)), seen(&tracer, Vec3::new(2., 0., 0.01)));
        // Factors: twice the squared distance, and the cosine of the angle.
        assert!((below / aside - 2. * 2f32.sqrt()).abs() < 0.05, "{below} {aside}");
    }

    #[test]
    fn light_of_a_panel_falls_with_the_angle_that_it_leaves_at_too() {
        let tracer = world(255, |contents, _| {
            let (at, facing) = (Vec3::new(0., 2., 0.), Vec3::NEG_Y);
            contents.lights.push(Light::Panel {
                at,
                right: Vec3::ZERO,
                up: Vec3::ZERO,
                facing,
                colour: Vec3::ONE,
            });
        });
        let (below, aside) =
            (seen(&tracer, Vec3::new(0.02, 0., 0.01)), seen(&tracer, Vec3::new(2., 0., 0.01)));
        // Factors: twice the squared distance, and the cosines of both angles.
        assert!((below / aside - 4.).abs() < 0.08, "{below} {aside}");
    }

    /// Under a uniform sky, a surface is as bright as the sky times its reflectance.
    #[test]
    fn floors_reflect_a_uniform_sky() {
        let light = Vec3::splat(0.7);
        let sky = Sky { zenith: light, horizon: light, ground: light, ..DARK };
        for grey in [90, 186] {
            let found = seen(&under(sky, grey, |_, _| {}), Vec3::new(0.3, 0., 0.2));
            assert!((found / (0.7 * reflectance(grey)) - 1.).abs() < 0.02, "{grey}: {found}");
        }
    }

    #[test]
    fn mirrors_reflect_the_scene() {
        let tracer = world(186, |contents, material| {
            contents.lights.push(Light::Sun { towards: Vec3::Y, spread: 0., colour: Vec3::splat(2.) });
            let mirror = Mesh::rectangle(Vec3::new(2., 0., -1.), 2. * Vec3::Z, 2. * Vec3::Y, 1.);
            contents.meshes.push((mirror, Material { mirror: 1., tint: Vec3::ZERO, ..material.clone() }));
        });
        let choice = SampleChoice { turn: 0, on_light: Vec2::splat(0.5) };
        // The ray goes from the mirror down to the floor.
        let mirrored =
            tracer.trace(Vec3::new(0., 1., 0.3), Vec3::new(2., -0.5, 0.).normalize(), 1e-3, choice).x;
        let floor = seen(&tracer, Vec3::new(0., 0., 0.3));
        assert!(floor > 0.1 && (mirrored / floor - 1.).abs() < 0.02, "{mirrored} {floor}");
    }

    /// Highlights follow the Blinn–Phong lobe, for an eye in the mirror direction of the sun.
    #[test]
    fn glossy_things_have_highlights() {
        let towards = Vec3::new(1., 1., 0.).normalize();
        let trace = |gloss: f32, eye: Vec3| {
            let tracer = world(0, |contents, material| {
                contents.lights.push(Light::Sun { towards, spread: 0., colour: Vec3::splat(2.) });
                let sheet = Mesh::rectangle(Vec3::new(-1., 0.5, 1.), 2. * Vec3::X, -2. * Vec3::Z, 1.);
                contents.meshes.push((sheet, Material { gloss, polish: 30., ..material.clone() }));
            });
            let choice = SampleChoice { turn: 0, on_light: Vec2::splat(0.5) };
            let at = Vec3::new(0.1, 0.5, 0.2);
            tracer.trace(at + eye, -eye.normalize(), 1e-3, choice).x
        };
        let mirrored = Vec3::new(-1., 1., 0.);
        let expected = 0.5 * 38. / (8. * PI) * towards.y * 2.;
        let found = trace(0.5, mirrored) - trace(0., mirrored);
        assert!((found / expected - 1.).abs() < 0.02, "{found}, expected {expected}");
        assert!(trace(0.5, Vec3::new(1., 1., 0.)) < 0.1 * found, "seen from the sun");
    }

    #[test]
    fn objects_cast_shadows_and_receive_bounced_light() {
        let sun = Light::Sun { towards: Vec3::Y, spread: 0., colour: Vec3::splat(3.) };
        let tracer = world(186, |contents, material| {
            contents.lights.push(sun);
            let ball = superellipsoid(Vec3::ONE, [1., 1.], 16).warped(|p| p + 1.5 * Vec3::Y);
            contents.meshes.push((ball, material.clone()));
        });
        let (shadow, lit) = (seen(&tracer, Vec3::new(0.1, 0., 0.1)), seen(&tracer, Vec3::new(2., 0., 2.)));
        assert!(shadow < 0.3 * lit, "{shadow} {lit}");
        // The lower side of the ball is lit by the floor alone.
        let choice = SampleChoice { turn: 0, on_light: Vec2::splat(0.5) };
        let below = tracer.trace(Vec3::new(0., 0.2, 0.), Vec3::Y, 1e-3, choice).x;
        assert!(below > 0.1 * lit && below < lit, "{below} {lit}");
    }

    #[test]
    fn triangles_have_no_gaps_between_them() {
        let tracer = world(128, |_, _| {});
        for i in 0..19 * 19 {
            let (a, b) = ((i % 19) as f32 / 2. - 4.5, (i / 19) as f32 / 2. - 4.5);
            let found = tracer.free_distance(Vec3::new(a, 1., b), Vec3::NEG_Y, 9.);
            assert!((found - 1.).abs() < 1e-5, "a gap at {a}, {b}");
        }
    }

    #[test]
    fn free_distance_ends_at_surfaces() {
        let tracer = world(128, |_, _| {});
        assert!((tracer.free_distance(Vec3::new(0.2, 3., 0.1), Vec3::NEG_Y, 10.) - 3.).abs() < 1e-5);
        assert_eq!(tracer.free_distance(Vec3::Y, Vec3::Y, 7.), 7.);
        assert_eq!(tracer.free_distance(Vec3::Y, Vec3::Y, f32::INFINITY), f32::INFINITY);
    }
}
