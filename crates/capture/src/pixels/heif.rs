//! HEIC and AVIF: files of boxes (ISO/IEC 14496-12, 23008-12). The size is read from them; libheif's program, or sips on macOS, decodes the
//! pixels.

use super::codec::decode_upright;
use globalsplat_files::{Error, Result, is_program_missing};
use image::{DynamicImage, ImageReader, RgbImage};
use std::io;
use std::path::Path;
use std::process::{Command, Stdio};

/// Brands of which a file of still images names at least one.
const BRANDS: [&[u8]; 10] =
    [b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"avif", b"avis"];

/// Names of libheif's program: since version 1.18, and before.
const PROGRAMS: [&str; 2] = ["heif-dec", "heif-convert"];

/// Number of bytes at the start of a file that hold its headers.
pub(super) const HEADER_BYTES: u64 = 1 << 16;

/// Returns (width, height) of the upright image in a file that begins with `start`, or `None` if it isn't HEIF.
///
/// A file may hold tiles, thumbnails and depths beside its image, none of them larger: the largest size is that of the image.
pub(super) fn heif_size(start: &[u8]) -> Option<(u32, u32)> {
    let brands = HeifBoxes(start).next().filter(|(kind, _)| *kind == b"ftyp")?.1;
    brands.chunks(4).any(|brand| BRANDS.contains(&brand)).then_some(())?;
    // Four bytes of a version and flags precede the boxes in a `meta` box.
    let properties = find_box(find_box(find_box(start, b"meta")?.get(4..)?, b"iprp")?, b"ipco")?;
    let side = |bytes: &[u8]| Some(u32::from_be_bytes(*bytes.first_chunk()?));
    let sizes = HeifBoxes(properties).filter(|(kind, _)| *kind == b"ispe");
    let sizes =
        sizes.filter_map(|(_, contents)| Some((side(contents.get(4..)?)?, side(contents.get(8..)?)?)));
    let (width, height) = sizes.max_by_key(|(width, height)| u64::from(*width) * u64::from(*height))?;
    let quarter_turns =
        find_box(properties, b"irot").and_then(|contents| contents.first()).map_or(0, |turns| turns & 3);
    Some(if matches!(quarter_turns, 0 | 2) { (width, height) } else { (height, width) })
}

/// Decodes the upright image of `encoded`, the contents of `file`, by libheif's program on the PATH, or else on macOS by sips.
///
/// # Errors
/// Returns an error if the file is truncated or damaged, or if the program isn't installed.
pub(super) fn decode_heif(encoded: &[u8], file: &Path) -> Result<RgbImage> {
    let undecodable = |why: String| {
        let expected = "a JPEG or PNG, or libheif on the PATH (Debian and Ubuntu: apt install libheif-examples; macOS: brew install libheif)";
        Error::input(file, "the image", format!("undecodable ({why})"), expected)
    };
    let not_given = |e: io::Error| undecodable(format!("it can't be given to a decoder: {e}"));
    let folder = tempfile::tempdir().map_err(not_given)?;
    let [heif, png, jpeg] = ["photo.heif", "photo.png", "photo.jpg"].map(|name| folder.path().join(name));
    std::fs::write(&heif, encoded).map_err(not_given)?;
    let run = |command: &mut Command| command.stdin(Stdio::null()).output();
    let run_libheif =
        |program| run(Command::new(program).args([&heif, &png])).map(|output| ("libheif", output));
    let run_sips = |why| {
        if !cfg!(target_os = "macos") {
            return Err(why);
        }
        let format = ["-s", "format", "jpeg", "-s", "formatOptions", "best"];
        run(Command::new("sips").args(format).arg(&heif).arg("--out").arg(&jpeg))
            .map(|output| ("sips", output))
    };
    let output = run_libheif(PROGRAMS[0]).or_else(|_| run_libheif(PROGRAMS[1])).or_else(run_sips);
    let (name, output) = output.map_err(|e: io::Error| {
        undecodable(match is_program_missing(&e) {
            true => "libheif isn't on the PATH".to_string(),
            false => format!("libheif can't be started: {e}"),
        })
    })?;
    // sips writes the orientation into a JPEG's EXIF data; libheif turns the pixels.
    if let Ok(encoded) = std::fs::read(&jpeg)
        && output.status.success()
    {
        return Ok(decode_upright(&encoded, file)?.pixels);
    }
    let decode = |mut reader: ImageReader<_>| {
        reader.no_limits();
        reader.decode().ok()
    };
    let image = ImageReader::open(&png).ok().filter(|_| output.status.success()).and_then(decode);
    image.map(DynamicImage::into_rgb8).ok_or_else(|| {
        let message = String::from_utf8_lossy(&output.stderr);
        let message = message.lines().map(str::trim).collect::<Vec<_>>().join("; ");
        undecodable(format!(
            "{name}: {}",
            if message.is_empty() { output.status.to_string() } else { message }
        ))
    })
}

/// Returns the contents of the first box of a kind in `bytes`.
fn find_box<'a>(bytes: &'a [u8], kind: &[u8]) -> Option<&'a [u8]> {
    HeifBoxes(bytes).find(|(found, _)| *found == kind).map(|(_, contents)| contents)
}

/// Iterator over the boxes in some bytes: the kind of each, and its contents, as far as they are there.
struct HeifBoxes<'a>(&'a [u8]);

impl<'a> Iterator for HeifBoxes<'a> {
    type Item = (&'a [u8], &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let bytes = self.0;
        let kind = bytes.get(4..8)?;
        let (header, length) = match u32::from_be_bytes(*bytes.first_chunk()?) {
            0 => (8, bytes.len()),
            1 => (16, usize::try_from(u64::from_be_bytes(*bytes.get(8..)?.first_chunk()?)).ok()?),
            length => (8, length as usize),
        };
        let end = length.max(header);
        let contents = bytes.get(header..end.min(bytes.len()))?;
        self.0 = bytes.get(end..).unwrap_or_default();
        Some((kind, contents))
    }
}
