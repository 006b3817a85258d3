//! Files of a SOG: in a ZIP archive or in a folder, and their images.

use super::{IMAGES, META};
use crate::{Error, Result};
use globalsplat_files::{check_regular, parent_of, stored_zip, write_file, write_files};
use image_webp::{ColorType, EncoderParams, WebPDecoder, WebPEncoder};
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::io::{Cursor, Read};
use std::path::{Path, PathBuf};
use zip::ZipArchive;
use zip::read::ZipFile;

/// Expected place of a file, for messages.
const IN_ARCHIVE: &str = "a file in the archive";
/// Maximum ratio of decompressed to compressed size of a file in an archive, with `MAX_SMALL` bytes allowed in addition.
const MAX_RATIO: u64 = 64;
const MAX_SMALL: u64 = 1 << 20;

/// Image of four bytes per pixel, row by row.
pub struct Image {
    pub width: usize,
    pub pixels: Vec<[u8; 4]>,
}

/// Reader of a SOG's files.
pub struct Reader<'a> {
    path: &'a Path,
    /// Archive, or `None` for files in a folder.
    archive: Option<Archive<'a>>,
}

struct Archive<'a> {
    zip: ZipArchive<Cursor<&'a [u8]>>,
    /// Folder of the SOG's files, which ends in a separator if there is one.
    folder: String,
    /// Size of the archive in bytes.
    size: usize,
}

impl<'a> Archive<'a> {
    /// Returns the entry of the SOG's file `name` in the archive at `path`.
    fn entry(&mut self, path: &Path, name: &str) -> Result<ZipFile<'_>> {
        let entry = self.zip.by_name(&format!("{}{name}", self.folder));
        entry.map_err(|why| Error::input(path, name, format!("missing or damaged ({why})"), IN_ARCHIVE))
    }
}

impl<'a> Reader<'a> {
    /// Opens the archive at `path`, whose contents are `bytes`.
    pub fn open_zip(path: &'a Path, bytes: &'a [u8]) -> Result<Self> {
        let zip = ZipArchive::new(Cursor::new(bytes))
            .map_err(|why| Error::input(path, "the file", format!("damaged: {why}"), "a ZIP archive"))?;
        // macOS adds folders of its own.
        let names = zip.file_names().filter(|name| name.split(['/', '\\']).all(|part| part != "__MACOSX"));
        let is_folder = |name: &&str| name.is_empty() || name.ends_with(['/', '\\']);
        let folders: Vec<_> = names.filter_map(|name| name.strip_suffix(META)).filter(is_folder).collect();
        let folder = match &folders[..] {
            folders if folders.contains(&"") => String::new(),
            [folder] => folder.to_string(),
            _ => {
                let found = format!("with {} files {META}", folders.len());
                let expected =
                    "one, that of a SOG, with its images; other splats are read without an archive";
                return Err(Error::input(path, "the archive", found, expected));
            }
        };
        Ok(Reader { path, archive: Some(Archive { zip, folder, size: bytes.len() }) })
    }

    /// Opens the folder of the `meta.json` at `path`.
    pub fn open_folder(path: &'a Path) -> Self {
        Reader { path, archive: None }
    }

    /// Returns the path of the file `name` beside the `meta.json` of a folder.
    fn beside(&self, name: &str) -> Result<PathBuf> {
        if name.is_empty() || name.contains(['/', '\\']) || name == ".." {
            let found = format!("{name:?}");
            return Err(Error::input(self.path, "a file name", found, "a name without a folder"));
        }
        Ok(parent_of(self.path).join(name))
    }

    /// Returns the size in bytes of the files `names`, compressed if they are in an archive. A file that is named twice counts once.
    pub fn size<'n>(&mut self, names: impl Iterator<Item = &'n String>) -> Result<usize> {
        let names: BTreeSet<_> = names.collect();
        names.into_iter().try_fold(0, |size, name| {
            if let Some(archive) = &mut self.archive {
                let max = archive.size;
                return Ok((size + archive.entry(self.path, name)?.compressed_size() as usize).min(max));
            }
            let file = self.beside(name)?;
            Ok(size + std::fs::metadata(&file).map_err(Error::read(&file))?.len() as usize)
        })
    }

    /// Returns the contents of the file `name`, which must be in the archive or folder.
    pub fn file(&mut self, name: &str) -> Result<Vec<u8>> {
        let Some(archive) = &mut self.archive else {
            let file = self.beside(name)?;
            check_regular(&file)?;
            return std::fs::read(&file).map_err(Error::read(&file));
        };
        let refuse = |found: String| Error::input(self.path, name, found, IN_ARCHIVE);
        let (mut contents, size) = (vec![], archive.size as u64);
        let file = archive.entry(self.path, name)?;
        let max = MAX_SMALL + MAX_RATIO * file.compressed_size().min(size);
        file.take(max + 1).read_to_end(&mut contents).map_err(|why| refuse(format!("damaged: {why}")))?;
        match contents.len() as u64 > max {
            true => Err(refuse(format!("more than {max} bytes"))),
            false => Ok(contents),
        }
    }

    /// Returns the image `name`, which may have `max_pixels`. Their number is known before memory is allocated.
    pub fn image(&mut self, name: &str, max_pixels: usize) -> Result<Image> {
        let file = self.file(name)?;
        let damaged = |why: image_webp::DecodingError| {
            Error::input(self.path, name, format!("damaged: {why}"), "a WebP image")
        };
        let mut decoder = WebPDecoder::new(Cursor::new(&file)).map_err(damaged)?;
        let (width, height) = decoder.dimensions();
        let count = width as usize * height as usize;
        if count > max_pixels {
            let found = format!("of {width}×{height} pixels");
            return Err(Error::input(self.path, name, found, format!("{max_pixels} at most")));
        }
        let has_alpha = decoder.has_alpha();
        let mut bytes = vec![0; count * if has_alpha { 4 } else { 3 }];
        decoder.read_image(&mut bytes).map_err(damaged)?;
        let pixels = match has_alpha {
            true => bytes.as_chunks().0.to_vec(),
            false => bytes.as_chunks().0.iter().map(|&[red, green, blue]| [red, green, blue, 255]).collect(),
        };
        Ok(Image { width: width as usize, pixels })
    }
}

/// Returns the images as lossless WebP files, which allow 16,384 pixels in each dimension.
pub fn encode_all(path: &Path, images: Vec<(&'static str, Image)>) -> Result<Vec<(&'static str, Vec<u8>)>> {
    let encode = |(name, image): (&'static str, Image)| {
        let file = encode_webp(&image)
            .map_err(|why| Error::failed(format!("{}: {name} can't be encoded: {why}", path.display())))?;
        Ok((name, file))
    };
    images.into_par_iter().map(encode).collect()
}

/// Encodes an image with and without prediction of pixels from their neighbours, and returns the smaller file.
fn encode_webp(image: &Image) -> std::result::Result<Vec<u8>, image_webp::EncodingError> {
    let (color, channels) = match image.pixels.iter().all(|pixel| pixel[3] == 255) {
        true => (ColorType::Rgb8, 3),
        false => (ColorType::Rgba8, 4),
    };
    let bytes: Vec<u8> = image.pixels.iter().flat_map(|pixel| &pixel[..channels]).copied().collect();
    let height = image.pixels.len() / image.width;
    let encode = |use_predictor_transform| {
        let mut file = vec![];
        let mut encoder = WebPEncoder::new(&mut file);
        let mut params = EncoderParams::default();
        params.use_predictor_transform = use_predictor_transform;
        encoder.set_params(params);
        encoder.encode(&bytes, image.width as u32, height as u32, color).map(|()| file)
    };
    let (plain, predicted) = (encode(false)?, encode(true)?);
    Ok(if plain.len() <= predicted.len() { plain } else { predicted })
}

/// Writes `meta.json` and the images to a ZIP archive.
pub fn write_zip(path: &Path, meta: &[u8], images: &[(&'static str, Vec<u8>)]) -> Result<()> {
    // WebP can't be compressed further.
    let files = images.iter().map(|(name, file)| (*name, &file[..])).chain([(META, meta)]);
    let archive = stored_zip(files, 1);
    write_file(path, archive)
}

/// Writes `meta.json` to `path` and the images beside it. No file is replaced before all of them are written.
pub fn write_folder(path: &Path, meta: &[u8], images: &[(&'static str, Vec<u8>)]) -> Result<()> {
    let beside = images.iter().map(|(name, file)| (parent_of(path).join(name), &file[..]));
    write_files(beside.chain([(path.to_owned(), meta)]))?;
    // Images of an older splat of a higher SH degree.
    let is_old = |name: &&&str| images.iter().all(|(written, _)| written != *name);
    let old = IMAGES.iter().filter(is_old).map(|name| path.with_file_name(name));
    for old in old.filter(|file| file.is_file()) {
        std::fs::remove_file(&old).map_err(Error::write(&old))?;
    }
    Ok(())
}
