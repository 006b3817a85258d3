//! HEIC and AVIF: files of boxes (ISO/IEC 14496-12, 23008-12). The size is read from them; programs on the PATH decode the pixels.

use globalsplat_files::{Error, Result, is_program_missing};
use image::DynamicImage;
use image::metadata::Orientation;
use std::ffi::OsStr;
use std::path::Path;
use std::process::{Command, Stdio};

/// Brands of which a file of still images names at least one.
const BRANDS: [&[u8]; 10] =
    [b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"avif", b"avis"];

/// Number of bytes at the start of a file that hold its headers.
pub(super) const HEADER_BYTES: u64 = 1 << 16;

/// What the headers of a file say about its image.
pub(super) struct HeifHeader {
    /// Width and height before the rotation.
    size: (u32, u32),
    /// Rotation that every reader has to apply.
    rotation: Orientation,
}

impl HeifHeader {
    /// Reads the header of a file that begins with `start`, or returns `None` if it isn't HEIF.
    ///
    /// A file may hold tiles, thumbnails and depths beside its image, none of them larger: the largest size is that of the image.
    pub fn parse(start: &[u8]) -> Option<Self> {
        let mut boxes = HeifBoxes(start);
        let brands = boxes.next().filter(|first| first.kind == b"ftyp")?.contents;
        brands.chunks(4).any(|brand| BRANDS.contains(&brand)).then_some(())?;
        // Four bytes of a version and flags precede the boxes in a `meta` box.
        let meta = boxes.find(|part| part.kind == b"meta")?.contents.get(4..)?;
        let properties = HeifBoxes(meta).find(|part| part.kind == b"iprp")?.contents;
        let properties = HeifBoxes(properties).find(|part| part.kind == b"ipco")?.contents;
        let side = |bytes: &[u8]| Some(u32::from_be_bytes(*bytes.first_chunk()?));
        let size = |part: HeifBox| {
            (part.kind == b"ispe")
                .then(|| Some((side(part.contents.get(4..)?)?, side(part.contents.get(8..)?)?)))?
        };
        let size = HeifBoxes(properties)
            .filter_map(size)
            .max_by_key(|size| u64::from(size.0) * u64::from(size.1))?;
        let quarter_turns =
            HeifBoxes(properties).find(|part| part.kind == b"irot").and_then(|part| part.contents.first());
        let rotation = match quarter_turns.map_or(0, |turns| turns & 3) {
            0 => Orientation::NoTransforms,
            1 => Orientation::Rotate270,
            2 => Orientation::Rotate180,
            _ => Orientation::Rotate90,
        };
        Some(HeifHeader { size, rotation })
    }

    /// Returns (width, height) of the rotated image.
    pub fn rotated_size(&self) -> (u32, u32) {
        let (width, height) = self.size;
        match self.rotation {
            Orientation::Rotate90 | Orientation::Rotate270 => (height, width),
            _ => (width, height),
        }
    }

    /// Decodes the image of `encoded`, the contents of `file`, and rotates it: by the ffmpeg on the PATH, else by libheif's program.
    /// Versions of ffmpeg before 7.1 decode AVIF, and of HEIC at most one of the tiles that make up the photos of phones.
    ///
    /// # Errors
    /// Returns an error if the file is truncated or damaged, or if neither program is installed and decodes it.
    pub fn decode(&self, encoded: &[u8], file: &Path) -> Result<DynamicImage> {
        let undecodable = |why: String| {
            let expected = "a JPEG or PNG, to which heif-convert or sips converts it, or on the PATH an ffmpeg or heif-dec that decodes it";
            Error::input(file, "the image", format!("undecodable ({why})"), expected)
        };
        if HeifBoxes(encoded).any(|part| !part.is_whole) {
            return Err(undecodable("its data end before the image does".into()));
        }
        let given = |e| undecodable(format!("it can't be given to another program: {e}"));
        let folder = tempfile::tempdir().map_err(given)?;
        let [heif, bmp, png] = ["photo.heif", "photo.bmp", "photo.png"].map(|name| folder.path().join(name));
        std::fs::write(&heif, encoded).map_err(given)?;
        // A malicious file opens neither URLs nor other files.
        let read = "-v error -xerror -noautorotate -protocol_whitelist file -enable_drefs 0 -f mov -i"
            .split(' ')
            .map(OsStr::new);
        let write = "-frames:v 1 -pix_fmt bgr24".split(' ').map(OsStr::new);
        let arguments = read.chain([heif.as_os_str()]).chain(write).chain([bmp.as_os_str()]);
        let by_ffmpeg = run("ffmpeg", arguments, &bmp, self.size);
        let by_ffmpeg = by_ffmpeg.unwrap_or_else(|| Err("ffmpeg isn't on the PATH".into()));
        let image = by_ffmpeg.map(|mut image| {
            image.apply_orientation(self.rotation);
            image
        });
        // libheif's program, which has two names, rotates.
        let by_libheif = || {
            let run = |program| run(program, [heif.as_os_str(), png.as_os_str()], &png, self.rotated_size());
            ["heif-dec", "heif-convert"]
                .into_iter()
                .find_map(run)
                .map(|image| image.map(|image| image.into_rgb8().into()))
        };
        image.or_else(|why| by_libheif().unwrap_or(Err(why))).map_err(undecodable)
    }
}

/// Runs `program`, which decodes an image to the file `decoded`. Returns the image, or why it can't be decoded or hasn't the given `size`:
/// a single tile is smaller than the image. Returns `None` if the program isn't on the PATH.
fn run<'a>(
    program: &str,
    arguments: impl IntoIterator<Item = &'a OsStr>,
    decoded: &Path,
    size: (u32, u32),
) -> Option<std::result::Result<DynamicImage, String>> {
    let output = match Command::new(program).args(arguments).stdin(Stdio::null()).output() {
        Err(e) if is_program_missing(&e) => return None,
        Err(e) => return Some(Err(format!("the {program} on the PATH can't be started: {e}"))),
        Ok(output) => output,
    };
    let image = image::open(decoded).ok().filter(|_| output.status.success());
    Some(match image {
        Some(image) if (image.width(), image.height()) == size => Ok(image),
        Some(image) => {
            let (width, height) = (image.width(), image.height());
            Err(format!("{program} decodes {width}×{height} of its {}×{} pixels", size.0, size.1))
        }
        None => {
            let message = String::from_utf8_lossy(&output.stderr);
            // A line may begin with an address: `[mov @ 0x…] `.
            let lines = message.lines().map(|line| {
                let line = line.trim();
                line.strip_prefix('[').and_then(|line| line.split_once("] ")).map_or(line, |(_, line)| line)
            });
            let lines = lines.collect::<Vec<_>>().join("; ");
            Err(format!("{program}: {}", if lines.is_empty() { output.status.to_string() } else { lines }))
        }
    })
}

/// A part of a file.
struct HeifBox<'a> {
    kind: &'a [u8],
    /// The contents, as far as they are there.
    contents: &'a [u8],
    /// `true` if all of the contents are there.
    is_whole: bool,
}

/// Iterator over the boxes in some bytes.
struct HeifBoxes<'a>(&'a [u8]);

impl<'a> Iterator for HeifBoxes<'a> {
    type Item = HeifBox<'a>;

    fn next(&mut self) -> Option<HeifBox<'a>> {
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
        Some(HeifBox { kind, contents, is_whole: end <= bytes.len() })
    }
}
