//! A synthetic scene and a video of it.

use super::light::Sky;
use super::scene_builder::SceneBuilder;
use super::sensor::{PixelRng, Sensor};
use super::tracer::{SampleChoice, Tracer};
use super::walk::{CameraSpace, OrbitTarget, pose, walk};
use super::{objects, places};
use glam::{DMat3, DMat4, DVec2, DVec3, Vec2, Vec3, vec2};
use globalsplat_capture::{Camera, ImageSize, Intrinsics, Lens};
use image::{ImageBuffer, Pixel, Rgb, RgbImage, Rgba, RgbaImage};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::f32::consts::TAU;
use std::fmt;

/// Rays per pixel along each side.
const RAYS: u32 = 2;
/// Fraction of scenes with an object to walk around.
const EXHIBITS: f64 = 0.4;
/// Fraction of these objects that hang on a wall, if there are walls.
const HUNG: f64 = 0.35;
/// Maximum number of scenes that are built until one has a free camera path.
const WORLDS: u64 = 20;

/// Settings common to all videos of a dataset.
#[derive(Debug, Clone, Copy)]
pub struct VideoSettings {
    /// Number of images per video.
    pub frames: usize,
    /// Number of further images from poses off the camera path: 30° to its sides and above it, about the point in the middle of an image.
    /// Those of an object are seen from between the others.
    pub off_path: usize,
    /// `true` for a single object without surroundings, seen from all sides above the ground, by a camera without noise and vignetting.
    pub is_object: bool,
    /// Size of an image.
    pub size: ImageSize,
}

/// A scene and its cameras. Images are rendered on request.
pub struct Video {
    tracer: Tracer,
    sensor: Sensor,
    cameras: Vec<Camera>,
    frames: usize,
    seed: u32,
}

impl Video {
    /// Number of camera rays per pixel. Each of them samples a light source by one shadow ray.
    pub const RAYS_PER_PIXEL: u32 = RAYS * RAYS;

    /// Creates video number `index` of `seed`. The result doesn't depend on the number of threads.
    pub fn new(seed: u64, index: u64, settings: &VideoSettings) -> Video {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        (0..WORLDS)
            .find_map(|attempt| {
                random.set_stream(index.wrapping_mul(WORLDS).wrapping_add(attempt));
                random.set_word_pos(0);
                Video::attempt(random.clone(), settings)
            })
            .expect("a way through one of many worlds")
    }

    fn attempt(random: ChaCha8Rng, settings: &VideoSettings) -> Option<Video> {
        let builder = SceneBuilder::new(random);
        if settings.is_object {
            return Some(Video::of_object(&builder, settings));
        }
        let (place, orbit_target, sky) = world(&builder);
        let tracer = Tracer::new(builder.contents.take(), sky);
        let poses = walk(&builder, &tracer, place, orbit_target, settings.frames)?;
        let mut cameras = cameras(&builder, poses, settings.size);
        let seen = mean_light(&tracer, &cameras);
        let sensor = Sensor::draw(&builder, seen);
        let seed = builder.seed();
        let others = off_path(&tracer, &cameras, settings.off_path);
        cameras.extend(others);
        Some(Video { tracer, sensor, cameras, frames: settings.frames, seed })
    }

    fn of_object(builder: &SceneBuilder, settings: &VideoSettings) -> Video {
        let sky = places::sky(builder);
        places::add_sun(builder, &sky);
        let ball = objects::floating(builder);
        let tracer = Tracer::new(builder.contents.take(), sky);
        let mut cameras = cameras_around(ball, settings.size, 0., settings.frames);
        cameras.extend(cameras_around(ball, settings.size, 1., settings.off_path));
        let sensor = Sensor::draw(builder, mean_light(&tracer, &cameras)).without_variation();
        Video { tracer, sensor, cameras, frames: settings.frames, seed: builder.seed() }
    }

    /// Returns the cameras of the images: those of the path, then those off it.
    pub fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    /// Renders image `index`.
    pub fn photo(&self, index: usize) -> RgbImage {
        let camera = &self.cameras[index];
        self.render(
            index,
            size(camera),
            spread(camera),
            |at| Some(towards(camera, at)),
            |color, _| Rgb(color),
        )
    }

    /// Renders image `index` with a transparent sky. Colors aren't multiplied by the opacity.
    pub fn cutout(&self, index: usize) -> RgbaImage {
        let camera = &self.cameras[index];
        let eye = camera.c2w.w_axis.truncate().as_vec3();
        let towards_surface = |at| {
            let ray = towards(camera, at);
            self.tracer.free_distance(eye, ray, f32::INFINITY).is_finite().then_some(ray)
        };
        self.render(index, size(camera), spread(camera), towards_surface, |[r, g, b], rays| {
            Rgba([r, g, b, (255 * rays / Self::RAYS_PER_PIXEL) as u8])
        })
    }

    /// Renders what `lens` shows from the pose of image `index`. Pixels without a ray are black.
    pub fn photo_through(&self, index: usize, lens: &Lens) -> RgbImage {
        let size = lens.size();
        let rotation = DMat3::from_mat4(self.cameras[index].c2w);
        let middle = 0.5 * DVec2::new(size.width.into(), size.height.into());
        let [left, right] = [middle, middle + DVec2::X].map(|at| lens.unproject(at).unwrap_or(DVec3::Z));
        let spread = left.angle_between(right) as f32 / RAYS as f32;
        let towards = |at: Vec2| lens.unproject(at.as_dvec2()).map(|ray| (rotation * ray).as_vec3());
        self.render(index, size, spread, towards, |color, _| Rgb(color))
    }

    /// Renders an image of `size` from the position of image `index`. `towards` returns the unit direction through a position in pixels,
    /// or `None` for no ray; `spread` is the angle between neighbouring rays in radians. `to_pixel` takes the color of a pixel's rays, black
    /// without any, and their number.
    fn render<P: Pixel<Subpixel = u8>>(
        &self,
        index: usize,
        size: ImageSize,
        spread: f32,
        towards: impl Fn(Vec2) -> Option<Vec3>,
        to_pixel: impl Fn([u8; 3], u32) -> P,
    ) -> ImageBuffer<P, Vec<u8>> {
        let exposure = self.sensor.exposure((index % self.frames) as f32 / self.frames as f32);
        let half = 0.5 * vec2(size.width as f32, size.height as f32);
        let eye = self.cameras[index].c2w.w_axis.truncate().as_vec3();
        ImageBuffer::from_fn(size.width, size.height, |x, y| {
            let pixel = y * size.width + x;
            let mut random = PixelRng::new(self.seed, index as u32, pixel);
            let (mut light, mut rays) = (Vec3::ZERO, 0);
            for sample in 0..Self::RAYS_PER_PIXEL {
                let cell = vec2((sample % RAYS) as f32, (sample / RAYS) as f32);
                let jitter = vec2(random.uniform(), random.uniform());
                let at = vec2(x as f32, y as f32) + (cell + jitter) / RAYS as f32;
                let on_light = vec2(random.uniform(), random.uniform());
                let choice = SampleChoice { sample_index: sample as usize, on_light };
                let Some(ray) = towards(at) else { continue };
                let radiance = self.tracer.trace(eye, ray, spread, choice);
                // Clamp the radiance, so that a ray that hits a lamp doesn't dominate its pixel.
                light += radiance.min(Vec3::splat(8.));
                rays += 1;
            }
            let place = (vec2(x as f32, y as f32) - half) / half;
            let mean = light / rays.max(1) as f32;
            to_pixel(self.sensor.bytes(mean, exposure, place, index as u32, pixel), rays)
        })
    }

    /// Returns the depths along the camera's axis at the pixel centers of image `index`, row by row, in metres. They are infinite
    /// in the sky.
    pub fn depth(&self, index: usize) -> Vec<f32> {
        let camera = &self.cameras[index];
        let eye = camera.c2w.w_axis.truncate().as_vec3();
        let axis = camera.c2w.z_axis.truncate().as_vec3();
        let rows = (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y)));
        rows.map(|(x, y)| {
            let ray = towards(camera, vec2(x as f32 + 0.5, y as f32 + 0.5));
            self.tracer.free_distance(eye, ray, f32::INFINITY) * ray.dot(axis)
        })
        .collect()
    }
}

/// Prints a summary without the triangles.
impl fmt::Debug for Video {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "a video of {} frames, number {}", self.cameras.len(), self.seed)
    }
}

/// Builds a random scene, mostly rooms: people often photograph them, and they are the hardest to reconstruct.
fn world(builder: &SceneBuilder) -> (CameraSpace, Option<OrbitTarget>, Sky) {
    let mut sky = places::sky(builder);
    let place = match builder.chance(0.75) {
        true => places::room(builder, &mut sky),
        false => places::landscape(builder, &sky),
    };
    let orbit_target = builder.chance(EXHIBITS).then(|| match place.walls {
        Some(behind) if builder.chance(HUNG) => {
            let (spot, front) = on_a_wall(builder, place, behind);
            objects::hung(builder, spot, front)
        }
        _ => objects::orbit_target(builder, (0.5 * (place.min + place.max)).with_y(0.)),
    });
    (place, orbit_target, sky)
}

/// Returns a position on a wall, and the direction away from the wall.
fn on_a_wall(builder: &SceneBuilder, place: CameraSpace, behind: f32) -> (Vec3, Vec3) {
    let (least, most) = (place.min - behind, place.max + behind);
    let share = builder.vector([(0.2, 0.8), (0.3, 0.75), (0.2, 0.8)]);
    let spot = least + share * (most - least);
    match builder.within(0..4) {
        0 => (spot.with_x(least.x), Vec3::X),
        1 => (spot.with_x(most.x), Vec3::NEG_X),
        2 => (spot.with_z(least.z), Vec3::Z),
        _ => (spot.with_z(most.z), Vec3::NEG_Z),
    }
}

fn cameras(builder: &SceneBuilder, poses: Vec<DMat4>, size: ImageSize) -> Vec<Camera> {
    let (width, height) = (f64::from(size.width), f64::from(size.height));
    let focal = f64::from(builder.log_uniform(0.55, 1.6)) * width.min(height);
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: width / 2., cy: height / 2. };
    let camera = |c2w| Camera { intrinsics, c2w, width: size.width, height: size.height };
    poses.into_iter().map(camera).collect()
}

/// Angle between a view off the path and that of the path, in radians.
const OFF_PATH: f32 = std::f32::consts::FRAC_PI_6;
/// Maximum distance of the point about which cameras leave the path, in metres.
const FARTHEST_TARGET: f32 = 20.;

/// Returns `count` cameras off the path of `cameras`, spread over it: by turns to the left of one of its cameras, above it, and to its right,
/// by [`OFF_PATH`] about the point that it looks at. Where something is in the way they take another of these sides, or are nearer to that point.
fn off_path(tracer: &Tracer, cameras: &[Camera], count: usize) -> Vec<Camera> {
    let camera = |i: usize| {
        let camera = cameras[i * cameras.len() / count];
        let [right, _, forward, eye] = [0, 1, 2, 3].map(|i| camera.c2w.col(i).truncate().as_vec3());
        let depth = tracer.free_distance(eye, forward, FARTHEST_TARGET);
        let target = eye + 0.98 * depth * forward;
        let (sin, cos) = OFF_PATH.sin_cos();
        let side = |side: usize| {
            let aside =
                [-right, Vec3::Y, right][side % 3].reject_from_normalized(forward).normalize_or(right);
            let away = sin * aside - cos * forward;
            (tracer.free_distance(target, away, depth), away)
        };
        let is_free = |&(free, _): &(f32, Vec3)| free > 0.7 * depth;
        let (free, away) = (i..i + 3).map(side).find(is_free).unwrap_or_else(|| side(i));
        Camera { c2w: pose((target + 0.9 * free * away, -away, 0.)), ..camera }
    };
    (0..count).map(camera).collect()
}

/// Returns `count` cameras around a ball (middle, radius), which fills most of their images. They are spread evenly over the
/// directions above it, the first of them `turn` radians about the vertical axis.
fn cameras_around((middle, radius): (Vec3, f32), size: ImageSize, turn: f32, count: usize) -> Vec<Camera> {
    const HALF_ANGLE: f32 = 20. * TAU / 360.;
    const GOLDEN_ANGLE: f32 = 2.399_963;
    let (width, height) = (f64::from(size.width), f64::from(size.height));
    let focal = 0.5 * width.min(height) / f64::from(HALF_ANGLE.tan());
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: width / 2., cy: height / 2. };
    let distance = 1.05 * radius / HALF_ANGLE.sin();
    let camera = |i: usize| {
        let height = (i as f32 + 0.5) / count as f32;
        let (sin, cos) = (turn + GOLDEN_ANGLE * i as f32).sin_cos();
        let ring = (1. - height * height).sqrt();
        let away = Vec3::new(ring * cos, height, ring * sin);
        let c2w = pose((middle + distance * away, -away, 0.));
        Camera { intrinsics, c2w, width: size.width, height: size.height }
    };
    (0..count).map(camera).collect()
}

fn size(camera: &Camera) -> ImageSize {
    ImageSize { height: camera.height, width: camera.width }
}

/// Returns the angle between the rays of a pixel, in radians.
fn spread(camera: &Camera) -> f32 {
    1. / (camera.intrinsics.fx as f32 * RAYS as f32)
}

/// Returns the unit direction from the camera through `at`, in pixels.
fn towards(camera: &Camera, at: Vec2) -> Vec3 {
    let Intrinsics { fx, fy, cx, cy } = camera.intrinsics;
    let x = (at.x - cx as f32) / fx as f32;
    let y = (at.y - cy as f32) / fy as f32;
    let [right, down, forward] =
        [camera.c2w.x_axis, camera.c2w.y_axis, camera.c2w.z_axis].map(|axis| axis.truncate().as_vec3());
    (x * right + y * down + forward).normalize()
}

/// Returns the geometric mean of the radiance of a few rays of a few images. With it, a lamp or a window in the image doesn't
/// darken everything else.
fn mean_light(tracer: &Tracer, cameras: &[Camera]) -> Vec3 {
    const SIDE: usize = 8;
    let mut sum = Vec3::ZERO;
    let picked = [0, cameras.len() / 2, cameras.len() - 1];
    for camera in picked.map(|index| &cameras[index]) {
        let eye = camera.c2w.w_axis.truncate().as_vec3();
        for i in 0..SIDE * SIDE {
            let cell = vec2((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5) / SIDE as f32;
            let at = cell * vec2(camera.width as f32, camera.height as f32);
            let choice = SampleChoice { sample_index: i, on_light: Vec2::splat(0.5) };
            let radiance = tracer.trace(eye, towards(camera, at), 0.05, choice);
            sum += radiance.max(Vec3::splat(0.01)).map(f32::ln);
        }
    }
    (sum / (picked.len() * SIDE * SIDE) as f32).map(f32::exp)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pinhole_lens_shows_the_photo_and_no_light_comes_from_outside_a_lens() {
        let settings = VideoSettings { frames: 2, off_path: 0, is_object: false, size: [24, 32].into() };
        let video = Video::new(1, 3, &settings);
        let Intrinsics { fx, fy, cx, cy } = video.cameras[1].intrinsics;
        let lens = |model, parameters: &[f64]| Lens::from_colmap(model, parameters, settings.size).unwrap();
        let through = video.photo_through(1, &lens("PINHOLE", &[fx, fy, cx, cy]));
        let photo = video.photo(1);
        // Rays that graze an edge may hit something else after rounding.
        let same = through
            .pixels()
            .zip(photo.pixels())
            .filter(|(a, b)| a.0.iter().zip(b.0).all(|(a, b)| a.abs_diff(b) <= 1));
        assert!(same.count() >= 24 * 32 * 99 / 100);
        // The circle of this lens has a radius of 5π pixels; the corners are 20 pixels from the center.
        let circle = video.photo_through(1, &lens("SIMPLE_FISHEYE", &[5., 16., 12.]));
        assert!(circle.get_pixel(0, 0).0.iter().all(|value| *value < 8), "{:?}", circle.get_pixel(0, 0));
        assert!(circle.get_pixel(16, 12).0.iter().any(|value| *value > 8));
    }

    /// An object is opaque in the middle of every image, and touches no border; the rest is transparent.
    #[test]
    fn objects_are_cut_out_and_seen_from_all_sides() {
        for number in 0..6 {
            let settings = VideoSettings { frames: 5, off_path: 2, is_object: true, size: [48, 48].into() };
            let video = Video::new(3, number, &settings);
            assert_eq!(video.cameras.len(), 7);
            for index in 0..7 {
                let image = video.cutout(index);
                let share = |part: &dyn Fn(u32, u32) -> bool| {
                    let counted = image.enumerate_pixels().filter(|(x, y, _)| part(*x, *y));
                    let opacities: Vec<f32> = counted.map(|(.., pixel)| f32::from(pixel[3]) / 255.).collect();
                    opacities.iter().sum::<f32>() / opacities.len() as f32
                };
                let border = share(&|x, y| x.min(y) == 0 || x.max(y) == 47);
                let whole = share(&|_, _| true);
                assert!(border == 0. && whole > 0.02 && whole < 0.8, "{number} {index}: {border} {whole}");
                // A ray through the middle of a pixel may pass where the others of this pixel don't.
                let depth = video.depth(index);
                let differ = |(pixel, depth): &(&Rgba<u8>, f32)| {
                    pixel[3] == 0 && depth.is_finite() || pixel[3] == 255 && depth.is_infinite()
                };
                let differing = image.pixels().zip(depth).filter(differ).count();
                assert!(differing < 48 * 48 / 100, "{number} {index}: {differing}");
            }
        }
    }
}
