//! Videos, written frame by frame: GIF by our own code, MP4 by the ffmpeg on the PATH.

use super::images::rgb_from_tensor;
use crate::error::{Error, Result};
use crate::scene::ImageSize;
use globalsplat_files::{PartialFile, is_program_missing};
use image::RgbImage;
use std::fs::File;
use std::io::{BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::thread::JoinHandle;
use tch::Tensor;

/// A video that is being written. It appears at its path when it is finished; a video that is dropped earlier leaves no file.
pub struct VideoWriter {
    path: PathBuf,
    size: ImageSize,
    frames: u32,
    encoder: Encoder,
    // Declared after the encoder to be dropped after it: the encoder writes to this file until it is dropped.
    partial: PartialFile,
}

/// Returns the extension of `path` in lowercase, which determines the format of a video.
fn format_of(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase()
}

enum Encoder {
    Gif(Gif),
    Mp4(Mp4),
}

impl VideoWriter {
    /// Checks that a video could be written at `path`, `.gif` or `.mp4`. Call it before the work starts.
    ///
    /// # Errors
    /// Returns an error for another extension, for more frames per second than the format supports, or if there is no ffmpeg with libx264
    /// for `.mp4`.
    pub fn check(path: &Path, frames_per_second: u32) -> Result<()> {
        match format_of(path).as_str() {
            "gif" => Gif::check(path, frames_per_second),
            "mp4" => Mp4::check(path),
            _ => Err(Error::input(path, "the video's file extension", path.display(), ".gif or .mp4")),
        }
    }

    /// Returns `true` if `path` has the extension of a video.
    pub fn has_video_extension(path: &Path) -> bool {
        ["gif", "mp4"].contains(&format_of(path).as_str())
    }

    /// Starts a video of `size`. An MP4 has even sides: the last row or column is cropped if their number is odd.
    ///
    /// # Errors
    /// Returns the errors of [`VideoWriter::check`], and an error if the format doesn't support the size or the file can't be written.
    pub fn begin(path: &Path, size: ImageSize, frames_per_second: u32) -> Result<Self> {
        Self::check(path, frames_per_second)?;
        let partial = PartialFile::create(path)?;
        let encoder = match format_of(path).as_str() {
            "gif" => Encoder::Gif(Gif::begin(path, partial.temporary.as_file(), size, frames_per_second)?),
            _ => Encoder::Mp4(Mp4::begin(path, partial.temporary.path(), size, frames_per_second)?),
        };
        Ok(VideoWriter { path: path.to_owned(), size, frames: 0, encoder, partial })
    }

    /// Adds a frame [3, H, W] in [0, 1], with a white margin if it is smaller than the video.
    ///
    /// # Errors
    /// Returns an error if the frame can't be encoded or written.
    pub fn add(&mut self, frame: &Tensor) -> Result<()> {
        let (height, width) = (i64::from(self.size.height), i64::from(self.size.width));
        let margin = [0, width - frame.size()[2], 0, height - frame.size()[1]];
        let frame = rgb_from_tensor(&frame.pad(margin, "constant", 1.))?;
        self.frames += 1;
        match &mut self.encoder {
            Encoder::Gif(gif) => gif.add(&self.path, &frame, self.frames),
            Encoder::Mp4(mp4) => mp4.add(&self.path, &frame),
        }
    }

    /// Finishes the video and moves it to its path.
    ///
    /// # Errors
    /// Returns an error if the video has no frame, or if it can't be encoded or written.
    pub fn finish(self) -> Result<()> {
        let VideoWriter { path, frames, encoder, partial, .. } = self;
        if frames == 0 {
            return Err(Error::request(format!("{}: a video needs at least one frame", path.display())));
        }
        match encoder {
            Encoder::Gif(gif) => gif.finish(&path)?,
            Encoder::Mp4(mut mp4) => mp4.end(&path)?,
        }
        partial.persist()
    }
}

struct Gif {
    encoder: gif::Encoder<BufWriter<File>>,
    frames_per_second: u32,
}

impl Gif {
    fn check(path: &Path, frames_per_second: u32) -> Result<()> {
        // Delays are in hundredths of a second, and browsers slow down frames with a delay of one.
        const MOST: u32 = 50;
        match frames_per_second {
            1..=MOST => Ok(()),
            many => Err(Error::input(path, "the number of frames per second", many, "1 to 50 in a .gif")),
        }
    }

    fn begin(path: &Path, file: &File, size: ImageSize, frames_per_second: u32) -> Result<Self> {
        let ImageSize { height, width } = size;
        let (Ok(sixteen_wide), Ok(sixteen_high)) = (u16::try_from(width), u16::try_from(height)) else {
            let found = format!("{width}×{height} pixels");
            return Err(Error::input(path, "the video's size", found, "65535 or less a side in a .gif"));
        };
        let writer = BufWriter::new(file.try_clone().map_err(Error::write(path))?);
        let encoder = gif::Encoder::new(writer, sixteen_wide, sixteen_high, &[]);
        let mut encoder = encoder.map_err(not_encoded(path))?;
        encoder.set_repeat(gif::Repeat::Infinite).map_err(not_encoded(path))?;
        Ok(Gif { encoder, frames_per_second })
    }

    /// Adds the frame with this `number`, which counts from 1.
    fn add(&mut self, path: &Path, frame: &RgbImage, number: u32) -> Result<()> {
        // 1 gives the best palette, 30 is the fastest.
        const SPEED: i32 = 10;
        let (width, height) = (frame.width() as u16, frame.height() as u16);
        let mut encoded = gif::Frame::from_rgb_speed(width, height, frame, SPEED);
        // The end time of each frame is rounded, so that frames don't drift from their times.
        let hundredths = |frames: u32| (100 * frames + self.frames_per_second / 2) / self.frames_per_second;
        encoded.delay = (hundredths(number) - hundredths(number - 1)) as u16;
        self.encoder.write_frame(&encoded).map_err(not_encoded(path))
    }

    fn finish(self, path: &Path) -> Result<()> {
        let writer = self.encoder.into_inner().map_err(not_encoded(path))?;
        writer.into_inner().map(drop).map_err(|e| Error::write(path)(e.into_error()))
    }
}

fn not_encoded(path: &Path) -> impl FnOnce(gif::EncodingError) -> Error {
    move |e| match e {
        gif::EncodingError::Io(e) => Error::write(path)(e),
        e => Error::failed_with_context(format_args!("{}: the video can't be encoded", path.display()))(e),
    }
}

/// Returns the version of the ffmpeg on the PATH, which must be able to encode H.264.
///
/// # Errors
/// Returns a message that says what is missing and how to install it.
pub fn find_ffmpeg() -> Result<String, String> {
    const GET: &str = "(Debian and Ubuntu: apt install ffmpeg; macOS: brew install ffmpeg)";
    let output = Command::new("ffmpeg").arg("-encoders").stdin(Stdio::null()).output();
    let output = output.map_err(|e| match is_program_missing(&e) {
        true => format!("ffmpeg isn't on the PATH {GET}"),
        false => format!("the ffmpeg on the PATH can't be started: {e} {GET}"),
    })?;
    if !String::from_utf8_lossy(&output.stdout).split_whitespace().any(|word| word == ENCODER) {
        return Err(format!("the ffmpeg on the PATH lacks {ENCODER} {GET}"));
    }
    // The banner begins with "ffmpeg version 5.1.9-0+deb12u1 Copyright …".
    let banner = String::from_utf8_lossy(&output.stderr);
    Ok(banner.split_whitespace().nth(2).unwrap_or("of unknown version").into())
}

/// Best H.264 encoder of ffmpeg, which machines without a GPU have too.
const ENCODER: &str = "libx264";

/// Encoder for H.264 in 4:2:0, which every player and browser shows.
struct Mp4 {
    ffmpeg: Child,
    /// Standard input of ffmpeg, until the video ends.
    input: Option<ChildStdin>,
    /// Thread that reads standard error while frames are written: a full pipe would block both processes.
    said: Option<JoinHandle<String>>,
}

impl Mp4 {
    fn check(path: &Path) -> Result<()> {
        find_ffmpeg().map(drop).map_err(|why| {
            let path = path.display();
            Error::request(format!(
                "{path}: {why}, expected for an .mp4; a .gif, or a folder for PNGs, needs nothing"
            ))
        })
    }

    fn begin(path: &Path, place: &Path, size: ImageSize, frames_per_second: u32) -> Result<Self> {
        /// Constant rate factor with almost no visible loss; ffmpeg's default is 23.
        const QUALITY: &str = "18";
        /// Declaration of sRGB colors. Without it, players assume BT.601 for small videos and BT.709 for large ones, and colors shift.
        const COLORS: &str =
            "-colorspace bt709 -color_primaries bt709 -color_trc iec61966-2-1 -color_range tv";
        let ImageSize { height, width } = size;
        if height < 2 || width < 2 {
            let found = format!("{width}×{height} pixels");
            return Err(Error::input(path, "the video's size", found, "2 pixels or more a side in an .mp4"));
        }
        let even = "crop=trunc(iw/2)*2:trunc(ih/2)*2";
        let to_yuv = "scale=in_range=pc:out_range=tv:out_color_matrix=bt709:flags=bicubic+accurate_rnd+full_chroma_int";
        let mut command = Command::new("ffmpeg");
        command
            .args("-v error -y -f rawvideo -pix_fmt rgb24".split(' '))
            .args(["-s", &format!("{width}x{height}")])
            .args(["-r", &frames_per_second.to_string(), "-i", "-", "-vf", &format!("{even},{to_yuv}")])
            .args(["-c:v", ENCODER, "-crf", QUALITY, "-pix_fmt", "yuv420p"])
            .args(COLORS.split(' '))
            // Puts the index that a player needs at the start, so that a page shows the video while it still loads.
            .args(["-movflags", "+faststart", "-f", "mp4"])
            .arg(place)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped());
        // Ctrl-C must reach only this program, which then ends ffmpeg.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut ffmpeg = command.spawn().map_err(Error::failed_with_context("ffmpeg can't be started"))?;
        let input = ffmpeg.stdin.take();
        let mut errors = ffmpeg.stderr.take().expect("a pipe was asked for");
        let said = std::thread::spawn(move || {
            let mut said = vec![];
            let _ = errors.read_to_end(&mut said);
            String::from_utf8_lossy(&said).trim().replace('\n', "; ")
        });
        Ok(Mp4 { ffmpeg, input, said: Some(said) })
    }

    fn add(&mut self, path: &Path, frame: &RgbImage) -> Result<()> {
        if self.input.as_mut().expect("an open pipe to ffmpeg").write_all(frame).is_err() {
            // The message of ffmpeg is more helpful than the broken pipe.
            self.end(path)?;
            return Err(Error::failed(format!("{}: ffmpeg ended early", path.display())));
        }
        Ok(())
    }

    /// Closes the input of ffmpeg and waits until it has written everything.
    fn end(&mut self, path: &Path) -> Result<()> {
        self.input = None;
        let status = self.ffmpeg.wait().map_err(Error::write(path))?;
        let said = self.said.take().and_then(|said| said.join().ok()).unwrap_or_default();
        let why = if said.is_empty() { format!(" ({status})") } else { format!(": {said}") };
        match status.success() {
            true => Ok(()),
            false => Err(Error::failed(format!("{}: ffmpeg failed{why}", path.display()))),
        }
    }
}

impl Drop for Mp4 {
    fn drop(&mut self) {
        // No-op if ffmpeg has ended already.
        let _ = self.ffmpeg.kill();
        let _ = self.ffmpeg.wait();
    }
}
