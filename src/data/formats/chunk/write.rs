//! Captures into chunks.

use super::{Chunk, EXTENSION, camera_numbers};
use crate::data::capture::Capture;
use crate::data::holdout::Holdout;
use crate::error::{Error, Result};
use crate::io::{write_atomically, write_json};
use globalsplat_csrc::chunk::{EncodedImage, SceneToPickle, pickle_scenes};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// By which a folder of chunks is recognized: {key: chunk's file name}.
pub const INDEX_FILE: &str = "index.json";

/// Writes chunks and their index into a folder.
#[derive(Debug)]
pub struct ChunkWriter {
    folder: PathBuf,
    /// Bytes of images after which a chunk is written.
    chunk_bytes: usize,
    waiting: Vec<SceneToPickle>,
    waiting_bytes: usize,
    chunks: usize,
    index: BTreeMap<String, String>,
}

impl ChunkWriter {
    /// Chunks of about `chunk_bytes` in `folder`, which is there already.
    ///
    /// # Errors
    /// A folder that holds chunks already.
    pub fn new(folder: &Path, chunk_bytes: usize) -> Result<Self> {
        let index = folder.join(INDEX_FILE);
        if index.exists() {
            return Err(Error::input(
                folder,
                "the output",
                "a folder of chunks already",
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

    /// Takes over what is left where the same work was interrupted: chunks of the first of its scenes, which are called `keys` in
    /// their order, and of which `make` makes the first anew, for comparison. `each` sees all that are there. Returns how many.
    ///
    /// # Errors
    /// Chunks of other work, those of `make` and `each`.
    pub fn go_on(
        &mut self,
        keys: &[String],
        make: impl FnOnce() -> Result<Capture>,
        mut each: impl FnMut(usize, &Capture) -> Result<()>,
    ) -> Result<usize> {
        let mut make = Some(make);
        loop {
            let file = self.folder.join(self.chunk_name());
            if !file.exists() {
                return Ok(self.index.len());
            }
            let other = || Error::input(&file, "the output", "a chunk already", "a folder without chunks");
            let chunk = Chunk::read(&file)?;
            for key in chunk.keys() {
                let capture = chunk.capture(key)?;
                let number = self.index.len();
                if keys.get(number).is_none_or(|wanted| wanted != key) {
                    return Err(other());
                }
                if let Some(make) = make.take()
                    && !is_same(&capture, &make()?)?
                {
                    return Err(other());
                }
                each(number, &capture)?;
                self.index.insert(key.to_owned(), self.chunk_name());
            }
            self.chunks += 1;
        }
    }

    /// Adds a capture, by its name. JPEG and PNG files are taken as they are, bit for bit, unless their lens distorts, they
    /// lie on their side, or they have other than three channels of 8 bits; then they are encoded anew, a JPEG as a JPEG of
    /// high quality, everything else as a PNG. The views of a test part of its own are left out.
    ///
    /// # Errors
    /// A name that is there already, photos that can't be read, the system's refusal to write.
    pub fn add(&mut self, capture: &Capture) -> Result<()> {
        if let Some(chunk) = self.index.get(&capture.name) {
            let found = format!("{:?}, which {chunk} holds already", capture.name);
            return Err(Error::input(capture.file(), "the scene's name", found, "another for each scene"));
        }
        let (views, _) = capture.split(Holdout::None);
        let image = |&view| Ok(EncodedImage { bytes: capture.encoded(view)? });
        let images = views.par_iter().map(image).collect::<Result<Vec<_>>>()?;
        let bytes: usize = images.iter().map(|image| image.bytes.len()).sum();
        if !self.waiting.is_empty() && self.waiting_bytes + bytes > self.chunk_bytes {
            self.write_chunk()?;
        }
        self.index.insert(capture.name.clone(), self.chunk_name());
        self.waiting_bytes += bytes;
        self.waiting.push(SceneToPickle {
            key: capture.name.clone(),
            url: String::new(),
            timestamps: (0..views.len() as i64).collect(),
            cameras: capture.cameras()[..views.len()].iter().flat_map(camera_numbers).collect(),
            images,
        });
        Ok(())
    }

    /// Writes what is left, and the index, without which the chunks aren't found. Returns the number of chunks.
    ///
    /// # Errors
    /// The system's refusal to write.
    pub fn finish(mut self) -> Result<usize> {
        if !self.waiting.is_empty() {
            self.write_chunk()?;
        }
        write_json(&self.folder.join(INDEX_FILE), &self.index)?;
        Ok(self.chunks)
    }

    fn chunk_name(&self) -> String {
        format!("{:06}.{EXTENSION}", self.chunks)
    }

    fn write_chunk(&mut self) -> Result<()> {
        let file = self.folder.join(self.chunk_name());
        let bytes = pickle_scenes(&std::mem::take(&mut self.waiting))?;
        // The same bytes are what was left when the same work was interrupted.
        if file.exists() && std::fs::read(&file).map_err(Error::read(&file))? != bytes.as_slice() {
            return Err(Error::input(&file, "the output", "a chunk already", "a folder without chunks"));
        }
        write_atomically(&file, |writer| writer.write_all(bytes.as_slice()).map_err(Error::write(&file)))?;
        (self.chunks, self.waiting_bytes) = (self.chunks + 1, 0);
        Ok(())
    }
}

/// Whether both have as many photos, and the same first one.
fn is_same(a: &Capture, b: &Capture) -> Result<bool> {
    Ok(a.len() == b.len() && a.encoded(0)? == b.encoded(0)?)
}
