//! The loader gives the same samples with any number of threads, from any start position, and skips broken data.

use glam::{DMat4, DVec3};
use globalsplat::data::{
    Batch, Capture, DataConfig, DataLoader, JitterConfig, LoadedScene, SceneGroups, open_capture,
    write_cameras_json,
};
use globalsplat::error::{Error, Result};
use globalsplat::scene::{Camera, Intrinsics};
use image::{ImageFormat, Rgb, RgbImage, Rgba, RgbaImage};
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use tch::{Device, Tensor};

/// Size of the photos in pixels.
const WIDTH: u32 = 48;
const HEIGHT: u32 = 36;

/// Writes a capture of `views` JPEGs whose blue channel identifies the scene.
fn write_capture(folder: &Path, scene: u8, views: usize) -> Capture {
    std::fs::create_dir_all(folder).unwrap();
    let names: Vec<String> = (0..views).map(|view| format!("{view:03}.jpg")).collect();
    for (view, name) in names.iter().enumerate() {
        let photo = RgbImage::from_fn(WIDTH, HEIGHT, |x, y| {
            Rgb([x as u8 * 5, (y + view as u32) as u8 * 4, scene * 40])
        });
        photo.save(folder.join(name)).unwrap();
    }
    let intrinsics = Intrinsics { fx: 40., fy: 41., cx: 23., cy: 18.5 };
    let at = |view: usize| DMat4::from_translation(DVec3::new(view as f64, 0.1 * (view % 3) as f64, 0.));
    let cameras: Vec<Camera> =
        (0..views).map(|view| Camera { intrinsics, c2w: at(view), width: WIDTH, height: HEIGHT }).collect();
    write_cameras_json(&folder.join("cameras.json"), &names, &cameras).unwrap();
    open_capture(folder).unwrap()
}

fn config() -> DataConfig {
    DataConfig {
        image_size: [16, 24].into(),
        context_views: 4,
        target_views: 2,
        window: [6, 9],
        flip: true,
        prefetch: 5,
        max_bad_share: 0.,
        ..Default::default()
    }
}

/// Captures in groups; an empty group stands for a broken file, `None` for a broken capture. Without any, the only group panics.
#[derive(Debug)]
struct Groups(Vec<Vec<Option<Capture>>>);

impl SceneGroups for Groups {
    fn sizes(&self) -> Vec<usize> {
        if self.0.is_empty() { vec![1] } else { self.0.iter().map(|group| group.len().max(2)).collect() }
    }

    fn open(&self, group: usize) -> Result<Vec<Result<Capture>>> {
        assert!(!self.0.is_empty(), "group {group} must not be opened");
        if self.0[group].is_empty() {
            return Err(Error::failed(format!("group {group} is broken")));
        }
        let broken = || Error::failed("a camera is NaN");
        Ok(self.0[group].iter().map(|capture| capture.clone().ok_or_else(broken)).collect())
    }

    fn decoded_bytes(&self) -> Option<u64> {
        None
    }
}

fn groups(folder: &Path, sizes: &[usize]) -> Groups {
    let mut scene = 0;
    let mut group = |count: usize| {
        let captures = (0..count).map(|_| {
            scene += 1;
            Some(write_capture(&folder.join(format!("{scene}")), scene, 12))
        });
        captures.collect()
    };
    Groups(sizes.iter().map(|&count| group(count)).collect())
}

fn scenes(loader: &mut DataLoader, count: usize) -> Vec<LoadedScene> {
    (0..count).map(|_| loader.next_scene().unwrap()).collect()
}

fn assert_same(a: &[LoadedScene], b: &[LoadedScene]) {
    assert_eq!(a.len(), b.len());
    for (a, b) in a.iter().zip(b) {
        assert_eq!((&a.context, &a.target), (&b.context, &b.target));
        assert!(a.images == b.images && a.far == b.far);
        for (a, b) in a.cameras.iter().zip(&b.cameras) {
            assert!(a.c2w == b.c2w && a.intrinsics == b.intrinsics);
        }
    }
}

#[test]
fn samples_depend_on_seed_and_number_alone() {
    let folder = tempfile::tempdir().unwrap();
    let data = Arc::new(groups(folder.path(), &[2, 3, 2]));
    let load = |seed: u64, threads: usize, first: u64, count: usize| {
        let config = DataConfig { threads, ..config() };
        scenes(&mut DataLoader::start(&config, seed, data.clone(), 1, first).unwrap(), count)
    };
    let all = load(3, 1, 0, 17);
    assert_same(&load(3, 3, 0, 17), &all);
    assert_same(&load(3, 2, 5, 12), &all[5..]);
    assert_ne!(load(4, 2, 0, 17)[0].images, all[0].images);
    // A scene is augmented differently in each epoch.
    assert!(
        all.iter().enumerate().all(|(i, scene)| all[..i].iter().all(|other| other.images != scene.images))
    );
}

#[test]
fn depths_come_with_the_context_views() {
    let folder = tempfile::tempdir().unwrap();
    let data = Arc::new(groups(folder.path(), &[2, 3, 2]));
    let load = |depths: bool, threads: usize| {
        let config = DataConfig { depths, threads, ..config() };
        scenes(&mut DataLoader::start(&config, 3, data.clone(), 1, 0).unwrap(), 40)
    };
    let (plain, with) = (load(false, 1), load(true, 3));
    assert_same(&with, &plain);
    let mut unsure = 0;
    for (plain, with) in plain.iter().zip(&with) {
        assert!(plain.depths.is_none());
        let depths = with.depths.as_ref().unwrap();
        let pixels = 16 * 24;
        assert_eq!(depths.len(), 4 * 2 * pixels);
        let of = |channel: usize| depths.chunks(pixels).skip(channel).step_by(2).flatten();
        assert!(of(0).all(|&inverse| inverse.is_finite() && inverse >= 0.));
        assert!(of(1).all(|sure| (0. ..=1.).contains(sure)));
        unsure += usize::from(of(1).all(|&sure| sure == 0.));
    }
    // A tenth of the samples teaches a model to work without depths.
    assert!((1..=9).contains(&unsure), "{unsure} of 40");
    let batch = Batch::from_scenes(&with[..1], Device::Cpu).unwrap();
    assert_eq!(batch.context.depths.unwrap().size(), [1, 4, 2, 16, 24]);
    assert!(batch.target.depths.is_none());
}

#[test]
fn the_scenes_of_a_step_show_equally_many_views() {
    let folder = tempfile::tempdir().unwrap();
    let data = Arc::new(groups(folder.path(), &[4]));
    let config = DataConfig { min_context_views: 2, ..config() };
    let counts = |first: u64| -> Vec<usize> {
        let mut loader = DataLoader::start(&config, 0, data.clone(), 3, first).unwrap();
        let batches = (0..12).map(|_| loader.next_batch(3, Device::Cpu).unwrap());
        batches.map(|batch| batch.context_views()).collect()
    };
    let all = counts(0);
    assert_eq!(all.iter().copied().collect::<BTreeSet<_>>(), BTreeSet::from([2, 3, 4]));
    // A resumed run continues the random sequence.
    assert_eq!(counts(6)[..10], all[2..]);
}

#[test]
fn batches_stack_their_scenes() {
    let folder = tempfile::tempdir().unwrap();
    let data = Arc::new(groups(folder.path(), &[4]));
    let loader = || DataLoader::start(&config(), 0, data.clone(), 1, 0).unwrap();
    let batch = loader().next_batch(3, Device::Cpu).unwrap();
    assert_eq!(batch.context.images.size(), [3, 4, 3, 16, 24]);
    assert_eq!(batch.target.w2c.size(), [3, 2, 4, 4]);
    for (b, scene) in scenes(&mut loader(), 3).iter().enumerate() {
        for (v, &image) in scene.target.iter().enumerate() {
            let bytes = &scene.images[image * 3 * 16 * 24..][..3 * 16 * 24];
            let expected: Vec<f32> = bytes.iter().map(|&byte| f32::from(byte) / 255.).collect();
            let found = batch.target.images.get(b as i64).get(v as i64).flatten(0, -1);
            assert_eq!(Vec::<f32>::try_from(found).unwrap(), expected);
            let cx = batch.target.intrinsics.double_value(&[b as i64, v as i64, 0, 2]);
            assert!((cx - scene.cameras[image].intrinsics.cx).abs() < 1e-5);
        }
    }
}

fn tensors(sample: &Batch) -> [&Tensor; 9] {
    let Batch { context: a, target: b, far, .. } = sample;
    [&a.images, &a.c2w, &a.w2c, &a.intrinsics, &b.images, &b.c2w, &b.w2c, &b.intrinsics, far]
}

/// Batches that are prefetched to the device are the same. Tested on the CPU, which does the same as for a GPU except for the
/// copies.
#[test]
fn prefetched_batches_are_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let data = Arc::new(groups(folder.path(), &[4]));
    let loader = |first| DataLoader::start(&config(), 0, data.clone(), 2, first).unwrap();
    let (mut plain, mut ahead) = (loader(4), loader(4));
    for step in 0..4 {
        if step != 2 {
            // A second call is a no-op.
            ahead.prefetch_to_device(2, Device::Cpu);
            ahead.prefetch_to_device(2, Device::Cpu);
        }
        assert_eq!(ahead.position(), 4 + 2 * step, "what isn't handed out doesn't count");
        let [expected, found] = [&mut plain, &mut ahead].map(|of| of.next_batch(2, Device::Cpu).unwrap());
        assert_eq!(ahead.position(), plain.position());
        assert_eq!(expected.names, found.names);
        for (expected, found) in tensors(&expected).into_iter().zip(tensors(&found)) {
            assert_eq!((expected.kind(), expected.size()), (found.kind(), found.size()));
            assert!(expected.equal(found));
        }
    }
}

/// Errors in prefetched samples are reported when the samples are due, as without prefetching.
#[test]
fn errors_are_returned_at_the_position_of_their_sample() {
    let folder = tempfile::tempdir().unwrap();
    let data = Arc::new(with_bad_data(folder.path()));
    let config = DataConfig { max_bad_share: 0.2, threads: 1, ..config() };
    let errors = [false, true].map(|sends_ahead| {
        let mut loader = DataLoader::start(&config, 0, data.clone(), 1, 0).unwrap();
        let position = (0..24).find_map(|_| {
            if sends_ahead {
                loader.prefetch_to_device(2, Device::Cpu);
            }
            let position = loader.position();
            loader.next_batch(2, Device::Cpu).err().map(|error| (position, error.to_string()))
        });
        (position.expect("3 of 12 are too many"), loader.position())
    });
    assert_eq!(errors[0], errors[1]);
    let error = &errors[0].0.1;
    assert!(
        error.contains("of 12 scenes were skipped") && error.contains("data.max_bad_share allows 0.2"),
        "{error}"
    );
}

/// A cache of the photos doesn't change samples, and without augmentation every sample shows a view in the same way.
#[test]
fn cached_photos_and_views_without_augmentation_are_the_same_in_every_sample() {
    let folder = tempfile::tempdir().unwrap();
    let data = Arc::new(vec![write_capture(folder.path(), 1, 6)]);
    let load =
        |config: DataConfig| scenes(&mut DataLoader::start(&config, 0, data.clone(), 1, 0).unwrap(), 4);
    let config = || DataConfig { context_views: 6, window: [6, 6], ..config() };
    let [uncached, cached] = [0, 1].map(|photo_cache_mb| load(DataConfig { photo_cache_mb, ..config() }));
    assert_same(&uncached, &cached);
    let shown = load(DataConfig { jitter: JitterConfig::OFF, extra_crop: 0., flip: false, ..config() });
    assert!(shown.iter().all(|scene| scene.images == shown[0].images && scene.context == [0, 1, 2, 3, 4, 5]));
}

/// Masks are cropped, resized and mirrored as their photos are: white photos on transparent ground equal their opacity.
#[test]
fn masks_follow_their_photos() {
    let folder = tempfile::tempdir().unwrap();
    write_capture(folder.path(), 1, 6);
    for view in 0..6 {
        let is_opaque = |x: u32, y: u32| view == 0 || (x > 10 + view && (x + y) % 9 > 3);
        let photo =
            RgbaImage::from_fn(WIDTH, HEIGHT, |x, y| Rgba([255, 255, 255, 255 * u8::from(is_opaque(x, y))]));
        let bytes = std::fs::File::create(folder.path().join(format!("{view:03}.jpg"))).unwrap();
        // The content decides on the format, not the name.
        photo.write_to(&mut std::io::BufWriter::new(bytes), ImageFormat::Png).unwrap();
    }
    let data = Arc::new(vec![open_capture(folder.path()).unwrap()]);
    let config = DataConfig {
        context_views: 6,
        window: [6, 6],
        jitter: JitterConfig::OFF,
        photo_cache_mb: 1,
        ..config()
    };
    let mut loader = DataLoader::start(&config, 0, data, 1, 0).unwrap();
    let mut emptier = BTreeSet::new();
    for scene in scenes(&mut loader, 12) {
        let (masks, pixels) = (scene.masks.as_ref().expect("masks"), 16 * 24);
        for (mask, image) in masks.chunks(pixels).zip(scene.images.chunks(3 * pixels)) {
            assert!(mask == &image[..pixels]);
        }
        assert!(masks[..pixels].iter().all(|&weight| weight == 255));
        let half = |first: usize| -> u32 {
            let rows = masks[5 * pixels..].chunks(24);
            rows.flat_map(|row| &row[first..first + 12]).map(|&weight| u32::from(weight)).sum()
        };
        emptier.insert(half(0) < half(12));
        // Every pixel of a scene without masks counts.
        let scenes = [LoadedScene { masks: None, ..scene.clone() }, scene];
        let context = Batch::from_scenes(&scenes, Device::Cpu).unwrap().context;
        let masks = context.masks.unwrap();
        assert!(masks.get(0).equal(&masks.get(0).ones_like()));
        assert!(masks.get(1).equal(&context.images.get(1).narrow(1, 0, 1)));
    }
    assert_eq!(emptier.len(), 2, "mirrored, and not");
}

/// Returns seven good scenes, a broken group, a scene with broken cameras, a short one, and one with broken photos.
fn with_bad_data(folder: &Path) -> Groups {
    let mut data = groups(folder, &[3, 2, 2]);
    data.0[0].push(None);
    data.0[1].push(Some(write_capture(&folder.join("short"), 0, 5)));
    let broken = folder.join("broken");
    data.0[2].push(Some(write_capture(&broken, 0, 12)));
    for view in 0..12 {
        let photo = broken.join(format!("{view:03}.jpg"));
        let bytes = std::fs::read(&photo).unwrap();
        std::fs::write(&photo, &bytes[..bytes.len() / 2]).unwrap();
    }
    data.0.push(vec![]);
    data
}

#[test]
fn bad_data_are_counted_and_skipped() {
    let folder = tempfile::tempdir().unwrap();
    let data = Arc::new(with_bad_data(folder.path()));
    let load = |threads: usize, first: u64, count: usize| {
        let config = DataConfig { max_bad_share: 0.5, threads, ..config() };
        let mut loader = DataLoader::start(&config, 0, data.clone(), 1, first).unwrap();
        (scenes(&mut loader, count), loader.bad_data())
    };
    let (all, bad) = load(1, 0, 24);
    assert!(all.iter().all(|scene| scene.images.iter().any(|&byte| byte > 0)));
    let counts = [bad.scenes, bad.in_broken_files, bad.broken, bad.too_short, bad.with_broken_images];
    assert_eq!(counts, [12, 2, 1, 1, 1]);
    let line = bad.to_string();
    assert!(
        line.starts_with("5 of 12 scenes were skipped: 1 too short, 2 in broken files, 1 with"),
        "{line}"
    );
    assert_eq!(line.lines().count(), 1);
    // The samples that replace broken ones are determined by the sample number, too.
    assert_same(&load(3, 7, 17).0, &all[7..]);
}

#[test]
fn nothing_but_bad_data_and_panics_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let data = Arc::new(vec![write_capture(folder.path(), 0, 5)]);
    let config = DataConfig { max_bad_share: 1., ..config() };
    let error = DataLoader::start(&config, 0, data, 1, 0).unwrap().next_scene().unwrap_err().to_string();
    assert!(error.contains("no scene can be trained on: 1 of 1 scenes were skipped: 1 too short"), "{error}");
    assert!(error.contains("cameras.json: 5 training views, expected 6 or more (data.window)"), "{error}");
    let none = Arc::new(Vec::<Capture>::new());
    assert!(DataLoader::start(&config, 0, none, 1, 0).unwrap_err().to_string().contains("no scenes"));
    let error = DataLoader::start(&config, 0, Arc::new(Groups(vec![])), 1, 0).unwrap().next_scene();
    let error = error.unwrap_err().to_string();
    assert_eq!(error, "internal error while loading sample 0: group 0 must not be opened");
}
