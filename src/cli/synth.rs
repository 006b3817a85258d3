use super::{Output, progress};
use crate::Error;
use crate::data::{
    Capture, ChunkWriter, SyntheticDataset, load_views, write_nerf_capture, write_unless_other,
};
use crate::eval::{EvaluationIndex, SceneFrames};
use crate::io::{Mosaic, check_writable_dir, check_writable_png, tile_horizontally};
use crate::scene::ImageSize;
use crate::synth::VideoSettings;
use anyhow::Result;
use clap::Args;
use npyz::WriterBuilder;
use rayon::prelude::*;
use serde_json::json;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tch::Tensor;

/// Approximate bytes of photos per chunk.
const CHUNK_BYTES: usize = 20_000_000;

/// Generate videos of synthetic scenes, with exact cameras, for training and evaluation.
///
/// The scenes are rooms and outdoor scenes full of objects of all shapes and materials, filmed along a path past them or around
/// one, ray traced, in the chunk format of RealEstate10K, with an index.json and an evaluation_index.json. The same seed gives
/// the same bytes.
/// Training generates them on the fly if data.captures contains "synth:seed=1,scenes=10000".
#[derive(Args)]
#[command(after_help = "Examples:\n  \
    globalsplat synth --out scenes/train --scenes 2000\n  \
    globalsplat synth --out scenes/test --scenes 50 --first 2000 --contact-sheet scenes.png")]
pub struct Synth {
    /// Folder for index.json, 000000.torch, … or, with --off-path, for a folder per video
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Number of videos
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(SyntheticDataset::SCENES))]
    scenes: u64,
    /// Seed of the scenes
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// Index of the first video, to continue after others of the same seed
    #[arg(long, value_name = "I", default_value_t = 0, value_parser = clap::value_parser!(u64).range(SyntheticDataset::FIRST))]
    first: u64,
    /// Number of photos per video
    #[arg(long, value_name = "N", default_value_t = 24, value_parser = clap::value_parser!(u64).range(SyntheticDataset::FRAMES))]
    frames: u64,
    /// Side of a photo in pixels
    #[arg(long, value_name = "PIXELS", default_value_t = 128, value_parser = clap::value_parser!(u64).range(SyntheticDataset::SIZE))]
    size: u64,
    /// Write each video as a folder in the layout of NeRF's synthetic scenes, instead of chunks, with N test views off the camera's path:
    /// 30° to its sides and above it
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u64).range(0..=1000))]
    off_path: u64,
    /// Show a single object in each video, without surroundings, on transparent images from all sides above it; the test views are
    /// between the others
    #[arg(long, requires = "off_path")]
    objects: bool,
    /// Also write depth/SCENE.npy: exact depths [photos, rows, columns] in metres, infinite in the sky
    #[arg(long)]
    depth: bool,
    /// Also write an overview image, a row per video
    #[arg(long, value_name = "FILE")]
    contact_sheet: Option<PathBuf>,
}

/// Maximum number of videos in the overview, and number of images of each.
const SHEET: (usize, usize) = (16, 8);

impl Synth {
    pub fn run(self) -> Result<Output> {
        if let Some(sheet) = &self.contact_sheet {
            check_writable_png(sheet)?;
        }
        check_writable_dir(&self.out)?;
        let size = ImageSize { height: self.size as u32, width: self.size as u32 };
        let (frames, off_path) = (self.frames as usize, self.off_path as usize);
        let settings = VideoSettings { frames, off_path, is_object: self.objects, size };
        let videos = SyntheticDataset::new(self.seed, self.first, self.scenes, settings);
        let mut writer = ChunkWriter::new(&self.out, CHUNK_BYTES)?;
        let depths = self.out.join("depth");
        if self.depth {
            check_writable_dir(&depths)?;
        }
        let bar = progress::bar(self.scenes, "videos");
        let (mut index, mut rows) = (BTreeMap::new(), vec![]);
        // Scenes are generated in parallel, because most of the work on one scene runs on a single thread.
        let numbers: Vec<usize> = (0..self.scenes as usize).collect();
        let made = numbers.chunks(2 * rayon::current_num_threads()).map(|numbers| {
            let make = |&number| {
                let video = Arc::new(videos.video(number));
                let capture = videos.capture_of(number, video.clone())?;
                if self.depth {
                    self.write_depths(&depths.join(&capture.name).with_extension("npy"), &capture)?;
                }
                Ok((capture, video))
            };
            numbers.par_iter().map(make).collect::<Result<Vec<_>, Error>>()
        });
        for captures in made {
            for (capture, video) in captures? {
                if self.off_path > 0 {
                    let image_of = |view| match self.objects {
                        true => video.cutout(view).into(),
                        false => video.photo(view).into(),
                    };
                    write_nerf_capture(&self.out.join(&capture.name), &capture.cameras(), frames, image_of)?;
                } else {
                    writer.add(&capture)?;
                    index.insert(capture.name.clone(), SceneFrames::alternating(capture.len()));
                }
                if self.contact_sheet.is_some() && rows.len() < SHEET.0 {
                    rows.push(sheet_row(&capture)?);
                }
                bar.inc(1);
            }
        }
        let index = EvaluationIndex { file: self.out.join("evaluation_index.json"), scenes: index };
        if self.off_path == 0 {
            index.write()?;
        }
        if let Some(sheet) = &self.contact_sheet {
            let mut mosaic = Mosaic::column(rows.len());
            rows.iter().try_for_each(|row| mosaic.add(std::slice::from_ref(row)))?;
            mosaic.write(sheet)?;
        }
        // This must be last: a folder with the index of its chunks is finished, and nothing more is written there.
        let chunks = (self.off_path == 0).then(|| writer.finish()).transpose()?;
        bar.finish_and_clear();
        let (out, scenes) = (self.out.to_string_lossy(), self.scenes);
        let files = chunks.map_or("folders".into(), |chunks| format!("{chunks} chunks"));
        Ok(Output::new(
            json!({
                "out": out, "scenes": scenes, "chunks": chunks, "index": chunks.map(|_| index.file.to_string_lossy()),
                "depth": self.depth.then_some(depths.to_string_lossy()),
                "contact_sheet": self.contact_sheet.as_deref().map(Path::to_string_lossy),
            }),
            format!("{out}: {scenes} videos of {} photos in {files}", self.frames + self.off_path),
        ))
    }

    /// Writes the depths of a video, unless an interrupted run has. Those of another video aren't replaced.
    fn write_depths(&self, file: &Path, capture: &Capture) -> Result<(), Error> {
        let depths = (0..capture.len()).filter_map(|view| capture.depth(view)).flatten();
        let shape = [self.frames + self.off_path, self.size, self.size];
        let (mut bytes, options) = (vec![], npyz::WriteOptions::new().default_dtype().shape(&shape));
        let mut npy = options.writer(&mut bytes).begin_nd().expect("memory");
        npy.extend(depths).and_then(|()| npy.finish()).expect("memory");
        write_unless_other(file, &bytes, "existing depths")
    }
}

/// Returns images of a video side by side, from the first to the last.
fn sheet_row(capture: &Capture) -> Result<Tensor, Error> {
    let shown: Vec<usize> = (0..SHEET.1).map(|i| i * (capture.len() - 1) / (SHEET.1 - 1)).collect();
    let pictures: Vec<Tensor> =
        load_views(capture, &shown, None)?.into_iter().map(|view| view.image.to_float()).collect();
    Ok(tile_horizontally(&pictures))
}
