//! ffmpeg and ffprobe, run as processes.

use super::grey::Grey;
use globalsplat_files::{Error, Result, is_program_missing};
use serde_json::Value;
use std::ffi::OsString;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread::JoinHandle;
use std::time::Duration;

/// What ffprobe tells of a video.
pub(super) struct Probe {
    /// Index of the picture stream in the file.
    stream: u64,
    /// Number of frames that the container declares.
    pub(super) declared_frames: Option<usize>,
    /// Duration in seconds, 0 if it isn't known.
    duration: f64,
    /// Average number of frames per second, 0 if it isn't known.
    pub(super) fps: f64,
    /// `true` if the transfer function is that of HDR: PQ or HLG.
    is_hdr: bool,
    is_interlaced: bool,
    /// `true` if the matrix of the colors isn't declared. Players then take HD for BT.709.
    is_undeclared_hd: bool,
}

impl Probe {
    /// Returns the number of frames by the file's declaration, or by its duration.
    pub(super) fn expected_frames(&self) -> Option<usize> {
        let by_duration = (self.duration * self.fps).round() as usize;
        self.declared_frames.or((by_duration > 0).then_some(by_duration))
    }
}

/// Asks ffprobe about the video at `path`.
///
/// # Errors
/// Returns an error if there is no ffprobe, or one that says why the file isn't a video.
pub(super) fn probe(path: &Path) -> Result<Probe> {
    let mut command = command("ffprobe");
    command.args(["-v", "error", "-of", "json", "-show_streams", "-show_format"]).arg(absolute(path)?);
    let output = run(path, command)?;
    let no_video = |found: &str| Err(Error::input(path, "the content", found, "a video"));
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        let why = said.lines().map(|line| message_of(line, path)).next().unwrap_or_default();
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
    // The first of the largest ones.
    let Some(stream) = streams.iter().filter(has_pictures).rev().max_by_key(|stream| area(stream)) else {
        let has_sound = streams.iter().any(|stream| stream["codec_type"] == "audio");
        return no_video(if has_sound { "sound without pictures" } else { "without pictures" });
    };
    let fps = text(&stream["avg_frame_rate"]);
    let fps = fps.split_once('/').and_then(|(frames, seconds)| {
        Some(frames.parse::<f64>().ok()? / seconds.parse::<f64>().ok().filter(|seconds| *seconds > 0.)?)
    });
    let declared_frames = number(&stream["nb_frames"]) as usize;
    Ok(Probe {
        stream: stream["index"].as_u64().unwrap_or(0),
        declared_frames: (declared_frames > 0).then_some(declared_frames),
        duration: number(&stream["duration"]).max(number(&found["format"]["duration"])),
        fps: fps.unwrap_or(0.),
        is_hdr: ["smpte2084", "arib-std-b67"].contains(&text(&stream["color_transfer"]).as_str()),
        is_interlaced: ["tt", "bb", "tb", "bt"].contains(&text(&stream["field_order"]).as_str()),
        is_undeclared_hd: stream["color_space"].as_str().is_none_or(|space| space == "unknown")
            && area(stream) >= 1280 * 720,
    })
}

/// Runs the passes of ffmpeg over a video.
pub(super) struct Converter<'a> {
    video: &'a Path,
    stream: u64,
    /// Options by which every frame is written once.
    every_frame: [&'static str; 2],
    /// Filter that every frame passes.
    deinterlace: &'static str,
    /// Filters that chosen frames pass.
    to_jpeg: String,
    /// What is wrong with the result, a sentence each.
    pub(super) warnings: Vec<String>,
}

impl<'a> Converter<'a> {
    /// Chooses the filters for a video.
    ///
    /// # Errors
    /// Returns an error if there is no ffmpeg.
    pub(super) fn new(video: &'a Path, probe: &Probe) -> Result<Self> {
        /// BT.2020 in PQ or HLG to BT.709, by linear light in which 1 is 100 cd/m².
        const TONEMAP: &str = "zscale=t=linear:npl=100,format=gbrpf32le,zscale=p=bt709,tonemap=hable:desat=0,\
                               zscale=t=bt709:m=bt709:r=tv,format=yuv420p,";
        let ask = |question: &str| {
            let mut command = command("ffmpeg");
            command.args(["-hide_banner", question]);
            run(video, command).map(|output| String::from_utf8_lossy(&output.stdout).into_owned())
        };
        let mut warnings = vec![];
        let mut tonemap = "";
        if probe.is_hdr {
            let filters = ask("-filters")?;
            if ["zscale", "tonemap"].iter().all(|name| filters.split_whitespace().any(|word| word == *name)) {
                tonemap = TONEMAP;
            } else {
                let lacks =
                    "the video is HDR, and the ffmpeg on the PATH lacks the filters zscale and tonemap";
                warnings.push(format!("{lacks}: colors are pale"));
            }
        }
        // JPEG has the color matrix of BT.601, and the full range.
        let from = if probe.is_undeclared_hd && tonemap.is_empty() { ":in_color_matrix=bt709" } else { "" };
        let scale = format!("scale=w=round(iw*sar):h=ih{from}:out_color_matrix=bt601:out_range=pc");
        Ok(Converter {
            video,
            stream: probe.stream,
            every_frame: match is_before_5_1(&ask("-version")?) {
                true => ["-vsync", "passthrough"],
                false => ["-fps_mode", "passthrough"],
            },
            deinterlace: if probe.is_interlaced { "yadif=deint=interlaced," } else { "" },
            to_jpeg: format!("{tonemap}{scale},format=yuvj420p"),
            warnings,
        })
    }

    /// Starts the first pass: every frame as a grey image of up to 640 pixels a side.
    pub(super) fn decode_small(&self) -> Result<Pass<'_>> {
        let scale = "scale=w='min(640,iw)':h='min(640,ih)':force_original_aspect_ratio=decrease:flags=area";
        let filter = format!("{}{scale},format=gray", self.deinterlace);
        let output = ["-f", "image2pipe", "-c:v", "pgm", "-"].map(OsString::from);
        self.start(&filter, &output, None)
    }

    /// Starts the second pass: the frames `chosen` as `frame_00001.jpg`, … in `folder`.
    pub(super) fn write(&self, chosen: &[usize], folder: &Path) -> Result<Pass<'_>> {
        let select = format!("select='{}'", expression_of(chosen));
        let filter = format!("{}{select},{},showinfo", self.deinterlace, self.to_jpeg);
        let count = chosen.len().to_string();
        let output = ["-frames:v", &count, "-c:v", "mjpeg", "-q:v", "2", "-f", "image2", "frame_%05d.jpg"];
        // The name of the folder may have a %, too.
        self.start(&filter, &output.map(OsString::from), Some(folder))
    }

    fn start(&self, filter: &str, output: &[OsString], folder: Option<&Path>) -> Result<Pass<'_>> {
        let mut command = command("ffmpeg");
        command
            .args(["-hide_banner", "-nostdin", "-nostats", "-v", "level+info", "-y", "-i"])
            .arg(absolute(self.video)?);
        command
            .args(["-map", &format!("0:{}", self.stream), "-vf", filter])
            .args(self.every_frame)
            .args(output);
        if let Some(folder) = folder {
            command.current_dir(folder);
        }
        let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
        let mut child = child.map_err(not_started(self.video, "ffmpeg"))?;
        let stdout = BufReader::new(child.stdout.take().expect("a pipe was requested"));
        let stderr = BufReader::new(child.stderr.take().expect("a pipe was requested"));
        let (sender, shown) = channel();
        let video = self.video.to_owned();
        let error = std::thread::spawn(move || {
            let mut first_error = None;
            for line in stderr.split(b'\n').map_while(std::io::Result::ok) {
                let line = String::from_utf8_lossy(&line);
                if let Some(frame) = Shown::parse(&line) {
                    // Nobody listens any more after a stop.
                    let _ = sender.send(frame);
                } else if line.contains("[error]") || line.contains("[fatal]") {
                    first_error.get_or_insert_with(|| message_of(&line, &video));
                }
            }
            first_error
        });
        Ok(Pass { converter: self, child, stdout, shown, error: Some(error) })
    }

    /// Returns the error that the work on the video failed.
    pub(super) fn failed(&self, why: impl std::fmt::Display) -> Error {
        Error::failed(format!("{}: {why}", self.video.display()))
    }

    /// Returns the error that the caller stopped the work.
    pub(super) fn stopped(&self) -> Error {
        self.failed("stopped before all frames were written")
    }
}

/// What ffmpeg tells of a frame that it writes.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Shown {
    /// Seconds from the start of the video; `None` if the file doesn't tell it.
    pub(super) time: Option<f64>,
    /// Width and height in pixels.
    pub(super) size: (u32, u32),
}

impl Shown {
    /// Parses a line of the filter showinfo: "… pts_time:1.5 … s:1920x1080 …".
    fn parse(line: &str) -> Option<Self> {
        let value = |key: &str| Some(line.split_once(key)?.1.split_whitespace().next().unwrap_or_default());
        let time = line.contains("showinfo").then(|| value(" pts_time:"))??;
        let (width, height) = value(" s:")?.split_once('x')?;
        Some(Shown { time: time.parse().ok(), size: (width.parse().ok()?, height.parse().ok()?) })
    }
}

/// A run of ffmpeg, which is killed on drop.
pub(super) struct Pass<'a> {
    converter: &'a Converter<'a>,
    child: Child,
    stdout: BufReader<ChildStdout>,
    shown: Receiver<Shown>,
    /// First error that ffmpeg reports.
    error: Option<JoinHandle<Option<String>>>,
}

impl Pass<'_> {
    /// Returns the next image of [`Converter::decode_small`]; `None` at the end of the video.
    pub(super) fn next_frame(&mut self) -> Result<Option<Grey>> {
        Grey::read(&mut self.stdout).map_err(Error::failed_with_context(format!(
            "{}: no frames from ffmpeg",
            self.converter.video.display()
        )))
    }

    /// Returns the next frames of [`Converter::write`], which may be none after 0.1 s; `None` at the end.
    pub(super) fn next_shown(&mut self) -> Option<Option<Shown>> {
        match self.shown.recv_timeout(Duration::from_millis(100)) {
            Ok(shown) => Some(Some(shown)),
            Err(RecvTimeoutError::Timeout) => Some(None),
            Err(RecvTimeoutError::Disconnected) => None,
        }
    }

    /// Waits for the end of ffmpeg.
    ///
    /// # Errors
    /// Returns the first error that ffmpeg reports if it fails.
    pub(super) fn finish(mut self) -> Result<()> {
        let status = self.child.wait().map_err(Error::failed_with_context("ffmpeg failed"))?;
        let error = self.error.take().and_then(|error| error.join().ok().flatten());
        match status.success() {
            true => Ok(()),
            false => Err(self
                .converter
                .failed(format!("ffmpeg failed: {}", error.unwrap_or_else(|| status.to_string())))),
        }
    }
}

impl Drop for Pass<'_> {
    fn drop(&mut self) {
        // No-op if ffmpeg has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Returns the command that runs a program of ffmpeg without input.
fn command(program: &str) -> Command {
    let mut command = Command::new(program);
    command.stdin(Stdio::null());
    // Ctrl-C must reach only this program, which then ends ffmpeg.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
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

/// Returns a line of ffmpeg without its prefixes: the module, such as "[mov @ 0x55aa]", the level, and the path of the video.
fn message_of(line: &str, video: &Path) -> String {
    let mut rest = line.trim();
    while let Some((_, after)) = rest.strip_prefix('[').and_then(|prefix| prefix.split_once("] ")) {
        rest = after;
    }
    let video = absolute(video).unwrap_or_default();
    rest.strip_prefix(&format!("{}: ", video.display())).unwrap_or(rest).into()
}

/// Returns `true` if ffmpeg introduces itself as a version before 5.1, which has no -fps_mode. Later versions have no -vsync.
fn is_before_5_1(banner: &str) -> bool {
    // "ffmpeg version 5.1.9-0+deb12u1 Copyright …", "ffmpeg version n7.1 …"; builds between versions have no such number.
    let version = banner.split_whitespace().nth(2).unwrap_or_default().trim_start_matches('n');
    let mut numbers = version.split(|c: char| !c.is_ascii_digit()).map_while(|part| part.parse::<u32>().ok());
    numbers.next().is_some_and(|major| (major, numbers.next().unwrap_or(0)) < (5, 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_are_told_apart() {
        for (version, is_before) in [
            ("4.4.2-0ubuntu0.22.04.1", true),
            ("5.0.1", true),
            ("n4.4", true),
            ("5.1.9-0+deb12u1", false),
            ("n7.1", false),
            ("8.0", false),
            ("10", false),
            ("N-118193-g5f38c82536", false),
            ("git-2024-01-01", false),
        ] {
            let banner = format!("ffmpeg version {version} Copyright (c) 2000-2025 the FFmpeg developers");
            assert_eq!(is_before_5_1(&banner), is_before, "{version}");
        }
    }
}
