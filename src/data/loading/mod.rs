//! Loading of training samples from captures, ahead of training. Worker threads read, decode, resize and augment samples. The i-th sample
//! depends on the seed and i alone. Each of T threads produces every T-th sample, and samples are taken from the threads in turn.

mod bad_data;
mod sample;
mod sampler;
mod scenes;

pub use bad_data::BadData;
pub use sample::{Batch, LoadedScene};
pub use sampler::BatchShard;
pub use scenes::{SceneGroups, TrainingScenes};

// Exchanged between processes.
pub(crate) use bad_data::{BadDataLog, BadSceneReport};

use crate::data::augment::Augmentation;
use crate::data::config::DataConfig;
use crate::device::Upload;
use crate::error::{Error, Result, panic_message};
use crate::scene::{Camera, ImageSize, normalize};
use crate::stereo::pixel_depths;
use bad_data::Fault;
use glam::DVec3;
use globalsplat_capture::{CHANNELS, Capture, Resampler};
use image::RgbImage;
use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sample::PendingBatch;
use sampler::{SceneIndex, SceneSampler, choose_views, draw_context_count};
use scenes::GroupCache;
use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use tch::{Device, Kind, Tensor};

/// Far plane of a frustum in units of the capture: these datasets have no metric scale (spec 2.3).
const FAR: f64 = 4. * 10.;

/// Fraction of the samples whose depths are all unsure, so that a model learns to work without depths, too.
const DEPTHS_LEFT_OUT: f64 = 0.1;

/// Source of training samples, delivered in order.
#[derive(Debug)]
pub struct DataLoader {
    shared: Arc<Shared>,
    receivers: Vec<Receiver<Result<LoadedScene>>>,
    threads: Vec<JoinHandle<()>>,
    shard: BatchShard,
    /// Index of the first sample.
    first: u64,
    /// Number of samples taken from the threads.
    taken: u64,
    upload: Option<Upload>,
    /// Index of the first sample of the prefetched batch, and the batch that is being copied, or the loading error to return when the
    /// batch is requested.
    prefetched: Option<(u64, Result<PendingBatch>)>,
}

/// Decoded photo, and its mask in equal channels, which is cropped and resized in the same way.
type MaskedPhoto = (RgbImage, Option<RgbImage>);

/// Decoded photos by scene and view.
type DecodedPhotos = HashMap<(SceneIndex, usize), Arc<MaskedPhoto>>;

/// State shared by all threads.
#[derive(Debug)]
struct Shared {
    config: DataConfig,
    seed: u64,
    sampler: SceneSampler,
    groups: GroupCache,
    bad_data_log: BadDataLog,
    /// Photo cache, if there is memory for all photos.
    photos: Option<Mutex<DecodedPhotos>>,
    stopped: AtomicBool,
}

/// Per-thread state that is reused from photo to photo.
#[derive(Debug, Default)]
struct WorkerState {
    resampler: Resampler,
    scratch: Vec<f32>,
}

impl DataLoader {
    /// Starts to load the samples of `scenes` that belong to `shard` of every step. A number as `shard` stands for whole steps of
    /// that many samples. The first step begins with sample `first`.
    ///
    /// # Errors
    /// Fails if there are no scenes, or if a thread can't be started.
    pub fn start(
        config: &DataConfig,
        seed: u64,
        scenes: Arc<dyn SceneGroups>,
        shard: impl Into<BatchShard>,
        first: u64,
    ) -> Result<Self> {
        let shard = shard.into();
        let sizes = scenes.sizes();
        if sizes.iter().all(|&size| size == 0) {
            return Err(Error::request("there are no scenes to train on"));
        }
        let fits = scenes
            .decoded_bytes()
            .is_some_and(|bytes| bytes <= config.photo_cache_mb.saturating_mul(1_000_000));
        let sampler = SceneSampler::new(sizes, seed);
        let shared = Arc::new(Shared {
            config: config.clone(),
            seed,
            bad_data_log: BadDataLog::new(sampler.scenes(), config.max_bad_share),
            sampler,
            groups: GroupCache::new(scenes),
            photos: fits.then(Default::default),
            stopped: AtomicBool::new(false),
        });
        let threads = match config.threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            threads => threads,
        };
        let mut loader = DataLoader {
            shared,
            receivers: vec![],
            threads: vec![],
            shard,
            first,
            taken: 0,
            upload: None,
            prefetched: None,
        };
        // A thread holds one more sample while its queue is full.
        let queue = config.prefetch.div_ceil(threads).saturating_sub(1).max(1);
        for thread in 0..threads as u64 {
            let (sender, receiver) = sync_channel(queue);
            let shared = loader.shared.clone();
            let turns = (thread..)
                .step_by(threads)
                .map(move |turn| (shard.sample(first, turn), shard.step(first, turn)));
            let work = move || {
                let mut state = WorkerState::default();
                for (sample, step) in turns {
                    // Nobody receives samples once the loader is dropped.
                    if shared.stopped.load(Ordering::Relaxed) {
                        return;
                    }
                    let load = AssertUnwindSafe(|| shared.load(sample, step, &mut state));
                    let scene = catch_unwind(load).unwrap_or_else(|panic| {
                        let why = panic_message(&*panic);
                        Err(Error::failed(format!("internal error while loading sample {sample}: {why}")))
                    });
                    if sender.send(scene).is_err() {
                        return;
                    }
                }
            };
            let spawned = std::thread::Builder::new().name(format!("loader-{thread}")).spawn(work);
            let spawned = spawned.map_err(Error::failed_with_context("a loading thread can't be started"))?;
            loader.receivers.push(receiver);
            loader.threads.push(spawned);
        }
        Ok(loader)
    }

    /// Returns the index of the next sample. A prefetched batch counts as not delivered.
    pub fn position(&self) -> u64 {
        self.prefetched.as_ref().map_or(self.next(), |&(first, _)| first)
    }

    /// Returns the index of the sample that the threads deliver next.
    fn next(&self) -> u64 {
        self.shard.sample(self.first, self.taken)
    }

    /// Returns the next sample.
    ///
    /// # Errors
    /// Fails if there is more bad data than the configuration allows.
    ///
    /// # Panics
    /// Panics if the next samples were prefetched for [`DataLoader::next_batch`].
    pub fn next_scene(&mut self) -> Result<LoadedScene> {
        assert!(self.prefetched.is_none(), "the next samples were prefetched");
        // Thread t produced the t-th sample, whatever its index.
        let turn = self.receivers.len();
        let receiver = &self.receivers[0];
        let scene = receiver.recv().map_err(|_| Error::failed("a loading thread has ended"))??;
        self.receivers.rotate_left(1 % turn);
        self.taken += 1;
        Ok(scene)
    }

    /// Returns the next `batch` samples as one batch: the prefetched ones, if any.
    ///
    /// # Errors
    /// Fails like [`DataLoader::next_scene`] and [`Batch::from_scenes`].
    pub fn next_batch(&mut self, batch: usize, device: Device) -> Result<Batch> {
        match self.prefetched.take() {
            Some((_, batch)) => batch?.wait(),
            None => {
                let scenes = self.next_scenes(batch)?;
                Batch::from_scenes_with(&scenes, self.upload(device)?)
            }
        }
    }

    /// Starts to copy the next `batch` samples to `device`, for the next [`DataLoader::next_batch`], which must get the same arguments.
    /// A GPU copies them while it computes. On the CPU nothing has to be copied.
    pub fn prefetch_to_device(&mut self, batch: usize, device: Device) {
        if self.prefetched.is_none() {
            let first = self.next();
            let scenes = self.next_scenes(batch);
            let pending = scenes.and_then(|scenes| PendingBatch::begin(&scenes, self.upload(device)?));
            self.prefetched = Some((first, pending));
        }
    }

    /// Returns the upload to `device`, which the first call creates.
    fn upload(&mut self, device: Device) -> Result<&Upload> {
        let upload = match self.upload.take() {
            Some(upload) => upload,
            None => Upload::new(device)?,
        };
        Ok(self.upload.insert(upload))
    }

    fn next_scenes(&mut self, count: usize) -> Result<Vec<LoadedScene>> {
        (0..count).map(|_| self.next_scene()).collect()
    }

    /// Returns the scenes skipped so far, including those skipped while prefetching.
    pub fn bad_data(&self) -> BadData {
        self.shared.bad_data_log.counts()
    }

    /// Returns the record of bad scenes, which processes that load other parts of the same steps exchange.
    pub(crate) fn bad_data_log(&self) -> &BadDataLog {
        &self.shared.bad_data_log
    }
}

impl Drop for DataLoader {
    fn drop(&mut self) {
        self.shared.stopped.store(true, Ordering::Relaxed);
        self.receivers.clear();
        for thread in self.threads.drain(..) {
            // A panic was already sent as an error.
            let _ = thread.join();
        }
    }
}

impl Shared {
    /// Loads sample `sample` of step `step`: the scene whose turn it is. A bad scene is replaced by another one of its group, or of
    /// the following groups if the group has no usable scene.
    fn load(&self, sample: u64, step: u64, state: &mut WorkerState) -> Result<LoadedScene> {
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        random.set_stream(sample);
        let context_count = draw_context_count(&self.config, self.seed, step);
        let (first, groups) = self.sampler.locate(sample);
        for group in groups {
            let opened = self.groups.open(group);
            let scenes = match &*opened {
                Ok(scenes) => scenes,
                Err(why) => {
                    let scene_indices =
                        (0..self.sampler.size(group)).map(|scene| SceneIndex { group, scene });
                    self.bad_data_log.add(Fault::Group, scene_indices, why)?;
                    continue;
                }
            };
            let mut turns: Vec<usize> = (0..self.sampler.size(group)).collect();
            if group == first.group {
                turns.swap_remove(first.scene);
                turns.insert(0, first.scene);
            }
            let mut shuffled = usize::from(group == first.group);
            for turn in 0..turns.len() {
                // The other scenes are shuffled only when needed: the first one is almost always good.
                if turn == shuffled {
                    turns[turn..].shuffle(&mut random);
                    shuffled = usize::MAX;
                }
                let scene_index = SceneIndex { group, scene: turns[turn] };
                let capture = scenes.get(scene_index.scene);
                match self.load_scene(scene_index, capture, context_count, &mut random, state) {
                    Ok(scene) => return Ok(scene),
                    Err((fault, why)) => self.bad_data_log.add(fault, std::iter::once(scene_index), why)?,
                }
            }
        }
        Err(self.bad_data_log.exhausted())
    }

    fn load_scene(
        &self,
        scene_index: SceneIndex,
        capture: Option<&Result<Capture>>,
        context_count: usize,
        random: &mut impl Rng,
        state: &mut WorkerState,
    ) -> Result<LoadedScene, (Fault, String)> {
        let broken = |why: &Error| (Fault::Scene, why.to_string());
        let capture = match capture {
            Some(Ok(capture)) => capture,
            Some(Err(why)) => return Err(broken(why)),
            None => return Err((Fault::Scene, "its file holds fewer scenes than it should".into())),
        };
        let in_capture = |why: Error| (Fault::Scene, format!("{}: {why}", capture.file().display()));
        let config = &self.config;
        let cameras = capture.cameras();
        let (shown, _) = capture.split(config.holdout);
        let centers: Vec<DVec3> = shown.iter().map(|&view| cameras[view].c2w.w_axis.truncate()).collect();
        let views = choose_views(config, context_count, &centers, random).ok_or_else(|| {
            let why = format!("{} training views, expected {} or more", shown.len(), config.window[0]);
            (Fault::Short, format!("{}: {why} (data.window)", capture.file().display()))
        })?;
        let augmentation = Augmentation::draw(config, random);

        let mut chosen = [&views.context[..], &views.target].concat();
        chosen.sort_unstable();
        chosen.dedup();
        let framed =
            chosen.iter().map(|&view| augmentation.visible_region(&cameras[shown[view]], config.image_size));
        let framed = framed.collect::<Result<Vec<_>>>().map_err(in_capture)?;
        let (regions, cameras): (Vec<_>, Vec<_>) = framed.into_iter().unzip();
        let among = |views: &[usize]| -> Vec<usize> {
            views.iter().map(|view| chosen.binary_search(view).expect("one of those chosen")).collect()
        };
        let (context, target) = (among(&views.context), among(&views.target));
        let (cameras, far) = normalized(cameras, &context, &target).map_err(in_capture)?;

        let size = config.image_size;
        let image_bytes = CHANNELS * size.height as usize * size.width as usize;
        let mut images = vec![0; chosen.len() * image_bytes];
        let (mut masks, mut mask_planes) = (None, vec![]);
        for (position, (planes, region)) in images.chunks_exact_mut(image_bytes).zip(regions).enumerate() {
            let photo = self
                .photo(scene_index, capture, shown[chosen[position]])
                .map_err(|why| (Fault::Image, why.to_string()))?;
            let (photo, mask) = &*photo;
            augmentation.crop_and_flip(&mut state.resampler, photo, region, size, planes);
            if let Some(mask) = mask {
                let pixels = image_bytes / CHANNELS;
                let masks = masks.get_or_insert_with(|| vec![u8::MAX; chosen.len() * pixels]);
                mask_planes.resize(image_bytes, 0);
                augmentation.crop_and_flip(&mut state.resampler, mask, region, size, &mut mask_planes);
                masks[position * pixels..][..pixels].copy_from_slice(&mask_planes[..pixels]);
            }
            augmentation.jitter.apply_to_bytes(planes, &mut state.scratch);
        }
        let depths = config.depths.then(|| match random.random_bool(DEPTHS_LEFT_OUT) {
            true => vec![0.; 2 * context.len() * image_bytes / CHANNELS],
            false => context_depths(&images, masks.as_deref(), size, &cameras, &context),
        });
        let name = capture.name.clone();
        Ok(LoadedScene { name, images, masks, depths, size, cameras, context, target, far })
    }

    fn photo(&self, scene_index: SceneIndex, capture: &Capture, view: usize) -> Result<Arc<MaskedPhoto>> {
        let Some(photos) = &self.photos else { return Ok(Arc::new(capture.photo_with_mask(view)?)) };
        let kept = photos.lock().expect("no thread panics here").get(&(scene_index, view)).cloned();
        if let Some(photo) = kept {
            return Ok(photo);
        }
        let photo = Arc::new(capture.photo_with_mask(view)?);
        photos.lock().expect("no thread panics here").insert((scene_index, view), photo.clone());
        Ok(photo)
    }
}

/// Returns `cameras` in the world coordinates normalized over context and target views together, where a view that is both counts
/// twice, and the distance of the far plane of their frusta.
fn normalized(cameras: Vec<Camera>, context: &[usize], target: &[usize]) -> Result<(Vec<Camera>, f64)> {
    let positions: Vec<usize> = context.iter().chain(target).copied().collect();
    let poses: Vec<_> = positions.iter().map(|&position| cameras[position].c2w).collect();
    let normalization = normalize(&poses)?;
    let mut cameras = cameras;
    for (&position, &c2w) in positions.iter().zip(&normalization.c2w) {
        cameras[position].c2w = c2w;
    }
    Ok((cameras, FAR / normalization.world_from_normalized.scale))
}

/// Computes the depths of the images at `context`, [C, 2, H, W] ([`pixel_depths`]). `images` and `masks` have the bytes of all images, of
/// `size`, with `cameras`.
fn context_depths(
    images: &[u8],
    masks: Option<&[u8]>,
    size: ImageSize,
    cameras: &[Camera],
    context: &[usize],
) -> Vec<f32> {
    let [height, width] = [size.height, size.width].map(i64::from);
    let indices = Tensor::from_slice(&context.iter().map(|&view| view as i64).collect::<Vec<_>>());
    let chosen = |bytes: &[u8], channels: i64| {
        let planes = Tensor::from_slice(bytes).view([-1, channels, height, width]);
        planes.index_select(0, &indices).to_kind(Kind::Float) / 255.
    };
    let masks = masks.map(|masks| chosen(masks, 1));
    let cameras: Vec<Camera> = context.iter().map(|&view| cameras[view]).collect();
    let depths = pixel_depths(&chosen(images, CHANNELS as i64), masks.as_ref(), &cameras);
    Vec::try_from(depths.flatten(0, -1)).expect("float32 values")
}
