//! HEIC and AVIF: files of boxes (ISO/IEC 14496-12, 23008-12). The size is read from them; programs on the PATH decode the pixels.

use globalsplat_files::{Error, Result, is_program_missing};
use image::metadata::Orientation;
use image::{DynamicImage, ImageFormat};
use std::io::Write;
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
        let by_ffmpeg = run_ffmpeg(encoded).and_then(|image| check_size("ffmpeg", image, self.size));
        let image = by_ffmpeg.map(|mut image| {
            image.apply_orientation(self.rotation);
            image
        });
        // libheif rotates.
        let by_libheif =
            || run_libheif(encoded).map(|image| check_size("libheif", image?, self.rotated_size()));
        image.or_else(|why| by_libheif().unwrap_or(Err(why))).map_err(undecodable)
    }
}

/// Returns `image` if it has the given size: a single tile is smaller than the image.
fn check_size(
    program: &str,
    image: DynamicImage,
    size: (u32, u32),
) -> std::result::Result<DynamicImage, String> {
    let (width, height) = (image.width(), image.height());
    if (width, height) == size {
        return Ok(image);
    }
    Err(format!("{program} decodes {width}×{height} of its {}×{} pixels", size.0, size.1))
}

/// Decodes `encoded` by ffmpeg without rotating it, or returns why ffmpeg can't.
fn run_ffmpeg(encoded: &[u8]) -> std::result::Result<DynamicImage, String> {
    let mut command = Command::new("ffmpeg");
    // The cache lets ffmpeg seek in its standard input.
    command
        .args(["-v", "error", "-xerror", "-noautorotate", "-protocol_whitelist", "cache,pipe", "-f", "mov"])
        .args([
            "-i",
            "cache:pipe:0",
            "-frames:v",
            "1",
            "-c:v",
            "bmp",
            "-pix_fmt",
            "bgr24",
            "-f",
            "image2pipe",
            "-",
        ])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut ffmpeg = command.spawn().map_err(|e| match is_program_missing(&e) {
        true => "ffmpeg isn't on the PATH".to_string(),
        false => format!("the ffmpeg on the PATH can't be started: {e}"),
    })?;
    let mut input = ffmpeg.stdin.take().expect("a pipe was asked for");
    let output = std::thread::scope(|scope| {
        // If ffmpeg ends early, its own message says why.
        scope.spawn(move || drop(input.write_all(encoded)));
        ffmpeg.wait_with_output()
    });
    let output = output.map_err(|e| format!("ffmpeg failed: {e}"))?;
    if output.status.success() && !output.stdout.is_empty() {
        return image::load_from_memory_with_format(&output.stdout, ImageFormat::Bmp)
            .map_err(|e| format!("ffmpeg wrote no image: {e}"));
    }
    let message = String::from_utf8_lossy(&output.stderr);
    // The cache reports that it can't seek to the end of a pipe, which is no error. A line may begin with an address: `[mov @ 0x…] `.
    let lines = message
        .lines()
        .map(str::trim)
        .filter(|line| !line.starts_with("[cache") && !line.starts_with("Last message"))
        .map(|line| {
            line.strip_prefix('[').and_then(|line| line.split_once("] ")).map_or(line, |(_, line)| line)
        });
    let lines = lines.collect::<Vec<_>>().join("; ");
    Err(if lines.is_empty() {
        format!("ffmpeg failed, {}", output.status)
    } else {
        format!("ffmpeg: {lines}")
    })
}

/// Decodes and rotates `encoded` by libheif's program, which has two names, or returns why it can't. Returns `None` if it isn't on the PATH.
fn run_libheif(encoded: &[u8]) -> Option<std::result::Result<DynamicImage, String>> {
    let run = || {
        let failed = |e| format!("libheif can't be given the image: {e}");
        let folder = tempfile::tempdir().map_err(failed)?;
        let [heic, png] = ["photo.heic", "photo.png"].map(|name| folder.path().join(name));
        std::fs::write(&heic, encoded).map_err(failed)?;
        for program in ["heif-dec", "heif-convert"] {
            match Command::new(program).args([&heic, &png]).stdin(Stdio::null()).output() {
                Err(e) if is_program_missing(&e) => {}
                Err(e) => return Err(format!("{program} failed: {e}")),
                Ok(output) => {
                    let message = String::from_utf8_lossy(&output.stderr);
                    return image::open(&png)
                        .map(Some)
                        .map_err(|_| format!("{program} failed: {}", message.trim()));
                }
            }
        }
        Ok(None)
    };
    run().transpose()
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
