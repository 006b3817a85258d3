//! Writer of chunks.

use crate::error::{Error, Result};
use crate::io::{write_file, write_json};
use globalsplat_capture::{
    CAMERA_NUMBERS, CHUNK_EXTENSION, CHUNK_INDEX_FILE, Capture, Holdout, camera_numbers,
};
use globalsplat_torch_file::{Dtype, Item, TensorView, serialize};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Scene that is not written yet, with the bytes of its tensors.
#[derive(Debug)]
struct WaitingScene {
    key: String,
    /// Numbers of the frames, int64.
    timestamps: Vec<u8>,
    /// Numbers of the cameras, float32.
    cameras: Vec<u8>,
    /// Size of `cameras`: the number of views, and the count of numbers per camera.
    size: [usize; 2],
    /// Lengths and contents of the image files.
    images: Vec<(usize, Vec<u8>)>,
}

/// Writes chunks and their index into a folder.
#[derive(Debug)]
pub struct ChunkWriter {
    folder: PathBuf,
    /// Size of the images in bytes after which a chunk is written.
    chunk_bytes: usize,
    waiting: Vec<WaitingScene>,
    waiting_bytes: usize,
    chunks: usize,
    index: BTreeMap<String, String>,
}

impl ChunkWriter {
    /// Creates a writer of chunks of about `chunk_bytes` in the existing folder `folder`.
    ///
    /// # Errors
    /// Fails if the folder already holds chunks.
    pub fn new(folder: &Path, chunk_bytes: usize) -> Result<Self> {
        let index = folder.join(CHUNK_INDEX_FILE);
        if index.exists() {
            return Err(Error::input(
                folder,
                "the output",
                "a folder that already contains chunks",
                "one without index.json",
            ));
        }
        Ok(ChunkWriter {
            folder: folder.to_owned(),
            chunk_bytes,
            waiting: vec![],
            waiting_bytes: 0,
            chunks: 0,
            index: BTreeMap::new(),
        })
    }

    /// Adds a capture under its name. JPEG and PNG files are copied bit for bit unless their lens distorts, they need rotating, or
    /// they don't have three channels of 8 bits. Those are encoded again, a JPEG as a JPEG of high quality, everything else as a
    /// PNG. The views of the capture's own test part are left out.
    ///
    /// # Errors
    /// Fails if the name is already taken, if a photo can't be read, or if a file can't be written.
    pub fn add(&mut self, capture: &Capture) -> Result<()> {
        if let Some(chunk) = self.index.get(&capture.name) {
            let found = format!("{:?}, which is already in {chunk}", capture.name);
            return Err(Error::input(capture.file(), "the scene's name", found, "another for each scene"));
        }
        let (views, _) = capture.split(Holdout::None);
        let image = |&view| capture.encoded(view).map(|bytes| (bytes.len(), bytes));
        let images = views.par_iter().map(image).collect::<Result<Vec<_>, _>>()?;
        let bytes: usize = images.iter().map(|(length, _)| length).sum();
        if !self.waiting.is_empty() && self.waiting_bytes + bytes > self.chunk_bytes {
            self.write_chunk()?;
        }
        self.index.insert(capture.name.clone(), self.chunk_name());
        self.waiting_bytes += bytes;
        let cameras = &capture.cameras()[..views.len()];
        self.waiting.push(WaitingScene {
            key: capture.name.clone(),
            timestamps: (0..views.len() as i64).flat_map(i64::to_le_bytes).collect(),
            cameras: cameras.iter().flat_map(camera_numbers).flat_map(f32::to_le_bytes).collect(),
            size: [views.len(), CAMERA_NUMBERS],
            images,
        });
        Ok(())
    }

    /// Writes the remaining scenes and the index, without which the chunks aren't found. Returns the number of chunks.
    ///
    /// # Errors
    /// Fails if a file can't be written.
    pub fn finish(mut self) -> Result<usize> {
        if !self.waiting.is_empty() {
            self.write_chunk()?;
        }
        write_json(&self.folder.join(CHUNK_INDEX_FILE), &self.index)?;
        Ok(self.chunks)
    }

    fn chunk_name(&self) -> String {
        format!("{:06}.{CHUNK_EXTENSION}", self.chunks)
    }

    fn write_chunk(&mut self) -> Result<()> {
        let file = self.folder.join(self.chunk_name());
        let bytes = chunk_bytes(&std::mem::take(&mut self.waiting))?;
        write_unless_other(&file, &bytes, "an existing chunk")?;
        (self.chunks, self.waiting_bytes) = (self.chunks + 1, 0);
        Ok(())
    }
}

/// Writes `bytes` to `file`. If it exists, it must have them already, from an interrupted run of the same work.
///
/// # Errors
/// Fails if the file can't be written, or has other contents: it is then called `found`.
pub(crate) fn write_unless_other(file: &Path, bytes: &[u8], found: &str) -> Result<()> {
    match file.exists() {
        false => write_file(file, bytes),
        true if std::fs::read(file).map_err(Error::read(file))? == bytes => Ok(()),
        true => Err(Error::input(file, "the output", found, "a folder without other scenes")),
    }
}

/// Returns the contents of a chunk: the list of its scenes as `torch.save` writes it.
fn chunk_bytes(scenes: &[WaitingScene]) -> Result<Vec<u8>> {
    fn tensor<'a>(dtype: Dtype, shape: &[usize], bytes: &'a [u8]) -> Item<'a> {
        Item::Tensor(TensorView::new(dtype, shape.into(), bytes).expect("the bytes of all elements"))
    }
    let scenes = scenes.iter().map(|scene| {
        let images = scene.images.iter();
        let images = images.map(|(length, bytes)| tensor(Dtype::U8, std::slice::from_ref(length), bytes));
        Item::Dict(vec![
            ("url", Item::Str("")),
            ("timestamps", tensor(Dtype::I64, &scene.size[..1], &scene.timestamps)),
            ("cameras", tensor(Dtype::F32, &scene.size, &scene.cameras)),
            ("images", Item::List(images.collect())),
            ("key", Item::Str(&scene.key)),
        ])
    });
    serialize(&Item::List(scenes.collect()))
}
