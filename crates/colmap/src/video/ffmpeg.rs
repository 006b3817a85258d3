//! ffmpeg and ffprobe, run as processes.

use crate::process::Process;
use globalsplat_files::{Error, Result, is_program_missing};
use image::GrayImage;
use serde_json::Value;
use std::fs;
use std::io::{self, BufRead, ErrorKind};
#[cfg(unix)]
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// PQ or HLG to BT.709, by linear light in which 1 is 100 cd/m². The declared colors of the input precede them.
const TONEMAP: &str = "t=linear:npl=100,format=gbrpf32le,zscale=p=bt709,tonemap=hable:desat=0,\
                       zscale=t=bt709:m=bt709:r=tv,format=yuv420p,";

/// A video, and how ffmpeg has to read it.
pub(super) struct Video<'a> {
    path: &'a Path,
    /// Index of the picture stream in the file, as an argument of ffmpeg.
    stream: String,
    /// Option by which every frame is written once.
    every_frame: &'static str,
    /// Filter that every frame passes.
    deinterlace: &'static str,
    /// Filters that chosen frames pass.
    to_jpeg: String,
    /// Number of frames that the container declares.
    pub(super) declared_frames: Option<usize>,
    /// Number of frames by the file's declaration, or by its duration; 0 if neither is known.
    pub(super) expected_frames: usize,
    /// What is wrong with the result, a sentence each.
    pub(super) warnings: Vec<String>,
}

impl<'a> Video<'a> {
    /// Asks ffprobe about the video at `path`, and chooses the filters for it.
    ///
    /// # Errors
    /// Returns an error if there is no ffprobe or ffmpeg, or one that says why the file isn't a video.
    pub(super) fn open(path: &'a Path) -> Result<Self> {
        if !fs::metadata(path).map_err(Error::read(path))?.is_file() {
            return Err(Error::input(path, "the path", "no file", "a video"));
        }
        let mut probe = command("ffprobe");
        probe.args(["-v", "error", "-of", "json", "-show_streams", "-show_format"]).arg(absolute(path)?);
        let output = run(path, probe)?;
        let no_video = |found: &str| Err(Error::input(path, "the content", found, "a video"));
        if !output.status.success() {
            let errors = String::from_utf8_lossy(&output.stderr);
            let why = message_in(errors.lines().next().unwrap_or_default(), path);
            return no_video(&format!("not readable by ffmpeg ({why})"));
        }
        let found: Value = serde_json::from_slice(&output.stdout)
            .map_err(Error::failed_with_context(format!("{}: ffprobe failed", path.display())))?;
        let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
        let number = |value: &Value| value.as_str().and_then(|text| text.parse::<f64>().ok()).unwrap_or(0.);

        let format = text(&found["format"]["format_name"]);
        let brand = text(&found["format"]["tags"]["major_brand"]);
        // ffmpeg shows text as a video of a terminal.
        if format == "tty" {
            return no_video("text");
        }
        if format == "image2"
            || format.ends_with("_pipe")
            || ["heic", "heix", "mif1", "avif"].contains(&brand.trim())
        {
            return no_video("a photo");
        }
        let streams = found["streams"].as_array().map(Vec::as_slice).unwrap_or_default();
        let has_pictures =
            |stream: &&Value| stream["codec_type"] == "video" && stream["disposition"]["attached_pic"] != 1;
        let area =
            |stream: &Value| stream["width"].as_u64().unwrap_or(0) * stream["height"].as_u64().unwrap_or(0);
        // Some cameras add a thumbnail as a stream of one frame.
        let moves = |stream: &Value| stream["nb_frames"] != "1";
        let rank = |stream: &&Value| (moves(stream), area(stream));
        // The first of the largest ones.
        let Some(stream) = streams.iter().filter(has_pictures).rev().max_by_key(rank) else {
            let has_sound = streams.iter().any(|stream| stream["codec_type"] == "audio");
            return no_video(if has_sound { "sound without pictures" } else { "without pictures" });
        };
        let size = |stream: &Value| (stream["width"].clone(), stream["height"].clone());
        let count = streams
            .iter()
            .filter(has_pictures)
            .filter(|other| moves(other) && size(other) == size(stream))
            .count();
        if count > 1 {
            let found = format!("{count} of {}×{} pixels", stream["width"], stream["height"]);
            let expected = "1: of a camera for 360 degrees, the stitched video, or one lens by ffmpeg -i VIDEO -map 0:v:0 -c copy LENS.mkv";
            return Err(Error::input(path, "the number of picture streams", found, expected));
        }
        let is_one_of = |field: &str, names: &[&str]| names.contains(&text(&stream[field]).as_str());
        let declared_frames = Some(number(&stream["nb_frames"]) as usize).filter(|count| *count > 0);
        let rate = text(&stream["avg_frame_rate"]);
        let rate = rate.split_once('/').and_then(|(frames, seconds)| {
            Some(frames.parse::<f64>().ok()? / seconds.parse::<f64>().ok().filter(|seconds| *seconds > 0.)?)
        });
        let seconds = number(&stream["duration"]).max(number(&found["format"]["duration"]));

        let ask = |question: &[&str]| {
            let mut command = command("ffmpeg");
            command.arg("-hide_banner").args(question);
            run(path, command).map(|output| String::from_utf8_lossy(&output.stdout).into_owned())
        };
        let picture = format!("0:{}", stream["index"]);
        let is_declared = |field| !is_one_of(field, &["", "unknown"]);
        let (mut warnings, mut tonemap) = (vec![], String::new());
        if is_one_of("color_transfer", &["smpte2084", "arib-std-b67"]) {
            let primaries = if is_declared("color_primaries") { "" } else { "pin=2020:p=2020:" };
            let matrix = if is_declared("color_space") { "" } else { "min=2020_ncl:" };
            tonemap = format!("zscale={primaries}{matrix}{TONEMAP}");
            let mut trial = command("ffmpeg");
            trial.args(["-v", "error", "-i"]).arg(absolute(path)?).args(["-map", &picture, "-vf"]);
            trial.args([tonemap.trim_end_matches(','), "-frames:v", "1", "-f", "null", "-"]);
            if !run(path, trial)?.status.success() {
                tonemap.clear();
                let lacks = "the ffmpeg on the PATH lacks the filters zscale and tonemap, or can't convert its colors";
                warnings.push(format!("the video is HDR, and {lacks}: colors are pale"));
            }
        }
        // Players take HD for BT.709 if the matrix of the colors isn't declared. JPEG has that of BT.601, and the full range.
        let is_bt709 = !is_declared("color_space") && area(stream) >= 1280 * 720 && tonemap.is_empty();
        let from = if is_bt709 { ":in_color_matrix=bt709" } else { "" };
        let scale = format!("scale=w=round(iw*sar):h=ih{from}:out_color_matrix=bt601:out_range=pc");
        Ok(Video {
            path,
            stream: picture,
            // ffmpeg has one option before 5.1, and the other since 8.
            every_frame: if ask(&["-h", "long"])?.contains("-fps_mode") { "-fps_mode" } else { "-vsync" },
            deinterlace: match is_one_of("field_order", &["tt", "bb", "tb", "bt"]) {
                true => "yadif=deint=interlaced,",
                false => "",
            },
            to_jpeg: format!("{tonemap}{scale},format=yuvj420p"),
            declared_frames,
            expected_frames: declared_frames.unwrap_or((seconds * rate.unwrap_or(0.)).round() as usize),
            warnings,
        })
    }

    /// Calls `on_frame` with every frame as a gray image of up to 640 pixels a side, and ends if it fails.
    pub(super) fn decode_small(&self, mut on_frame: impl FnMut(&GrayImage) -> Result<()>) -> Result<()> {
        let scale = "scale=w='min(640,iw)':h='min(640,ih)':force_original_aspect_ratio=decrease:flags=area";
        let filter = format!("{}{scale},format=gray", self.deinterlace);
        let mut process = self.start(&filter, &["-f", "image2pipe", "-c:v", "pgm", "-"], Path::new("."))?;
        let mut frames = process.take_output();
        let context = format!("{}: no frames from ffmpeg", self.path.display());
        while let Some(frame) = read_pgm(&mut frames).map_err(Error::failed_with_context(&context))? {
            on_frame(&frame)?;
        }
        self.finish(process, || Ok(()))
    }

    /// Writes the frames `chosen` as `frame_00001.jpg`, … to `folder`. Calls `watch` several times a second, and ends if it fails.
    pub(super) fn write(
        &self,
        chosen: &[usize],
        folder: &Path,
        watch: impl FnMut() -> Result<()>,
    ) -> Result<()> {
        let filter = format!("{}select='{}',{}", self.deinterlace, expression_of(chosen), self.to_jpeg);
        let (count, jpeg) = (chosen.len().to_string(), ["-c:v", "mjpeg", "-q:v", "2", "-f", "image2"]);
        // The name of the folder may have a %, too.
        let output = [&["-frames:v", &count], &jpeg[..], &["frame_%05d.jpg"]].concat();
        self.finish(self.start(&filter, &output, folder)?, watch)
    }

    fn start(&self, filter: &str, output: &[&str], folder: &Path) -> Result<Process> {
        let mut command = command("ffmpeg");
        command.args(["-hide_banner", "-nostdin", "-nostats", "-v", "error", "-y", "-i"]);
        command.arg(absolute(self.path)?).args(["-map", &self.stream, "-vf", filter]);
        command.args([self.every_frame, "passthrough"]).args(output).current_dir(folder);
        Process::start(command, true).map_err(not_started(self.path, "ffmpeg"))
    }

    /// Waits for the end of ffmpeg.
    ///
    /// # Errors
    /// Returns the error of `watch`, or the first error that ffmpeg reports if it fails.
    fn finish(&self, process: Process, mut watch: impl FnMut() -> Result<()>) -> Result<()> {
        let mut message = None;
        let status = process.wait(|line| {
            message = message.take().or(line);
            watch()
        })?;
        let why = message.map_or(status.to_string(), |message| message_in(&message, self.path));
        if status.success() { Ok(()) } else { Err(self.failed(format!("ffmpeg failed: {why}"))) }
    }

    /// Returns the error that the work on the video failed.
    pub(super) fn failed(&self, why: impl std::fmt::Display) -> Error {
        Error::failed(format!("{}: {why}", self.path.display()))
    }
}

/// Returns the command that runs a program of ffmpeg without input.
fn command(program: &str) -> Command {
    let mut command = Command::new(program);
    command.stdin(Stdio::null());
    // Ctrl-C must reach only this program, which then ends ffmpeg.
    #[cfg(unix)]
    command.process_group(0);
    command
}

/// Returns the expression that is true for the frames `chosen`, of which there must be at least one: a sum in parentheses, because ffmpeg
/// takes no more than 100 terms in a row.
fn expression_of(chosen: &[usize]) -> String {
    match chosen {
        [frame] => format!("eq(n,{frame})"),
        _ => {
            let (first, second) = chosen.split_at(chosen.len() / 2);
            format!("({}+{})", expression_of(first), expression_of(second))
        }
    }
}

/// Runs a command for `video` to its end.
fn run(video: &Path, mut command: Command) -> Result<Output> {
    let program = command.get_program().to_string_lossy().into_owned();
    command.output().map_err(not_started(video, &program))
}

/// Returns a closure for `map_err` that says that a program is missing, and where to get it.
fn not_started(video: &Path, program: &str) -> impl FnOnce(std::io::Error) -> Error {
    const GET: &str = "(Debian and Ubuntu: apt install ffmpeg; macOS: brew install ffmpeg)";
    let what = format!("{}: reading a video needs {program}", video.display());
    move |e| match is_program_missing(&e) {
        true => Error::request(format!("{what}, which isn't on the PATH {GET}")),
        false => Error::failed_with_context(format!("{what}, which can't be started"))(e),
    }
}

/// Returns the path by which ffmpeg reads a file: an absolute one, which it takes neither for an option nor for a URL.
fn absolute(path: &Path) -> Result<PathBuf> {
    std::path::absolute(path).map_err(Error::read(path))
}

/// Returns an error of ffmpeg without its prefixes: the module, such as "[mov @ 0x55aa]", and the path of the video.
fn message_in(line: &str, video: &Path) -> String {
    let mut message = line.trim();
    while let Some((_, after)) = message.strip_prefix('[').and_then(|prefix| prefix.split_once("] ")) {
        message = after;
    }
    let video = absolute(video).unwrap_or_default();
    message.strip_prefix(&format!("{}: ", video.display())).unwrap_or(message).into()
}

/// Reads a binary PGM as ffmpeg writes it: "P5", the size and the maximum, 255, in a line each. Returns `None` at the end of the data.
fn read_pgm(reader: &mut impl BufRead) -> io::Result<Option<GrayImage>> {
    if reader.fill_buf()?.is_empty() {
        return Ok(None);
    }
    let mut header = String::new();
    for _ in 0..3 {
        reader.read_line(&mut header)?;
    }
    let words: Vec<&str> = header.split_whitespace().collect();
    let ["P5", width, height, "255"] = words[..] else { return Err(ErrorKind::InvalidData.into()) };
    let parse = |word: &str| word.parse().map_err(|_| io::Error::from(ErrorKind::InvalidData));
    let mut image = GrayImage::new(parse(width)?, parse(height)?);
    reader.read_exact(&mut image)?;
    Ok(Some(image))
}
