//! Frames of videos that ffmpeg makes of a picture that moves in a known way.

use crate::has_ffmpeg;
use globalsplat_colmap::{Progress, Result, Step, VideoFrames, extract_frames};
use globalsplat_test_kit::{rerun_test, skip};
use image::{DynamicImage, GrayImage, RgbImage, imageops};
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use tempfile::TempDir;

const WIDTH: u32 = 320;
const HEIGHT: u32 = 180;

/// A temporary folder with videos, and the folder `frames` of the frames that are chosen.
struct Fixture {
    root: TempDir,
    picture: GrayImage,
}

impl Fixture {
    /// Returns `None` and skips the test without ffmpeg.
    fn new() -> Option<Self> {
        has_ffmpeg().then(|| Fixture { root: tempfile::tempdir().unwrap(), picture: picture(0) })
    }

    fn at(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    /// Runs ffmpeg in the folder; returns `true` if it succeeds.
    fn ffmpeg(&self, arguments: &[&str]) -> bool {
        let mut ffmpeg = Command::new("ffmpeg");
        ffmpeg.args(["-v", "error", "-y"]).args(arguments).current_dir(&self.root).stdin(Stdio::null());
        ffmpeg.output().unwrap().status.success()
    }

    /// Writes frames of one size to the video `name` in Matroska, at 25 frames per second; `options` follow the input.
    fn write_video(&self, name: &str, frames: &[GrayImage], options: &[&str]) {
        let size = format!("{}x{}", frames[0].width(), frames[0].height());
        let input = ["-f", "rawvideo", "-pix_fmt", "gray", "-r", "25", "-s", &size, "-i", "pixels"];
        let codec = ["-c:v", "mjpeg", "-q:v", "2", "-pix_fmt", "yuvj420p", "-f", "matroska", name];
        fs::write(self.at("pixels"), frames.iter().flat_map(|frame| frame.to_vec()).collect::<Vec<u8>>())
            .unwrap();
        assert!(self.ffmpeg(&[&input, options, &codec].concat()));
    }

    /// Returns what a camera sees of the picture whose left border is at each of `xs`.
    fn views(&self, xs: impl IntoIterator<Item = u32>) -> Vec<GrayImage> {
        xs.into_iter().map(|x| view(&self.picture, x)).collect()
    }

    /// Chooses frames of a video; those of an earlier call are removed.
    fn extract(&self, name: &str, count: Option<usize>) -> Result<VideoFrames> {
        let _ = fs::remove_dir_all(self.at("frames"));
        let frames = extract_frames(&self.at(name), &self.at("frames"), count, &mut |_| true);
        frames.map(|frames| frames.expect("nothing stops it"))
    }

    /// Writes frames to a video with the `options` of ffmpeg, and returns the indices of `count` that are chosen.
    fn choose(&self, frames: &[GrayImage], options: &[&str], count: usize) -> Vec<usize> {
        self.write_video("video.mkv", frames, options);
        let indices = self.extract("video.mkv", Some(count)).unwrap().indices;
        assert_eq!(indices.len(), count);
        indices
    }

    /// Returns the frame `index` of those that were written.
    fn frame(&self, index: usize) -> DynamicImage {
        image::open(self.at("frames").join(format!("frame_{:05}.jpg", index + 1))).unwrap()
    }
}

/// Returns a picture of noise at scales of 3 to 48 pixels, as large as the pans in these tests need; another one for each `seed`.
fn picture(seed: u32) -> GrayImage {
    let noise = |x: u32, y: u32, scale: u32| {
        let mix = |hash: u32, value: u32| (hash ^ value ^ (hash >> 15)).wrapping_mul(0x2c1b_3c6d);
        ([scale, x, y, 0].into_iter().fold(seed, mix) >> 24) as f32 - 127.5
    };
    GrayImage::from_fn(1000, HEIGHT, |x, y| {
        let smooth = |scale: u32| {
            let (i, j, u, v) =
                (x / scale, y / scale, (x % scale) as f32 / scale as f32, (y % scale) as f32 / scale as f32);
            let row = |j| noise(i, j, scale) * (1. - u) + noise(i + 1, j, scale) * u;
            row(j) * (1. - v) + row(j + 1) * v
        };
        image::Luma([(128. + 0.3 * smooth(3) + 0.4 * smooth(12) + 0.4 * smooth(48)) as u8])
    })
}

fn view(picture: &GrayImage, x: u32) -> GrayImage {
    imageops::crop_imm(picture, x, 0, WIDTH, HEIGHT).to_image()
}

/// Returns the mean absolute difference of an image to `expected` in gray levels.
fn difference(image: DynamicImage, expected: &GrayImage) -> f64 {
    let image = image.into_luma8();
    assert_eq!(image.dimensions(), expected.dimensions());
    let sum: f64 = image.iter().zip(expected.iter()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
    sum / image.len() as f64
}

fn names(folder: &Path) -> BTreeSet<String> {
    let entries = fs::read_dir(folder).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

#[test]
fn frames_are_equally_far_apart_and_a_pause_adds_none() {
    let Some(fixture) = Fixture::new() else { return };
    // Speeds, and the number of frames at each.
    let speeds = [(0, 20), (3, 40), (0, 50), (6, 40), (0, 20), (2, 30)];
    let mut xs = vec![];
    for speed in speeds.into_iter().flat_map(|(speed, frames)| std::iter::repeat_n(speed, frames)) {
        xs.push(xs.last().unwrap_or(&0) + speed);
    }
    let views = fixture.views(xs.iter().copied());
    // Names that ffmpeg would take for patterns, options or protocols.
    let (video, folder) = (fixture.at("-pan:%d.mkv"), fixture.at("frames %d"));
    fixture.write_video("pan", &views, &[]);
    fs::rename(fixture.at("pan"), &video).unwrap();
    let extract = |video: &Path, folder: &Path, count: Option<usize>| {
        extract_frames(video, folder, count, &mut |_| true).unwrap().expect("nothing stops it")
    };

    let frames = extract(&video, &folder, Some(14));
    assert!(frames.warnings.is_empty(), "{:?}", frames.warnings);
    assert_eq!(frames.summary, "14 of 200 frames, the sharpest of each segment of equal motion");
    let expected: BTreeSet<String> = (1..=14).map(|number| format!("frame_{number:05}.jpg")).collect();
    assert_eq!((names(&folder), frames.indices.len()), (expected, 14));
    fs::rename(&folder, fixture.at("frames")).unwrap();
    let length = 420. / 14.;
    for (k, &index) in frames.indices.iter().enumerate() {
        let x = f64::from(xs[index]) / length;
        // Displacements are measured to parts of a pixel of the small image, and the segments lie between frames.
        assert!((k as f64 - 0.3..=k as f64 + 1.3).contains(&x), "frame {k} at {x}");
        // The file shows this frame and no other.
        assert!(difference(fixture.frame(k), &views[index]) < 3.);
        let mut others = views.iter().zip(&xs).filter(|(_, x)| **x != xs[index]);
        assert!(others.all(|(other, _)| difference(fixture.frame(k), other) > 5.));
    }
    let chosen: Vec<u32> = frames.indices.iter().map(|&index| xs[index]).collect();
    assert!(chosen.windows(2).all(|pair| f64::from(pair[1] - pair[0]) > length / 4.), "{chosen:?}");

    // 1.3 widths would be 22 frames at the usual distance.
    assert_eq!(extract(&video, &folder, None).indices.len(), 30);
    // ffmpeg takes more than 100 frames in a nested expression only.
    let many = fixture.at("many");
    extract(&video, &many, Some(105));
    assert_eq!(names(&many).len(), 105);

    // A relative path, which leads elsewhere from the folder of the frames.
    let depth = std::env::current_dir().unwrap().components().skip(1).count();
    let relative = Path::new(&"../".repeat(depth)).join(video.strip_prefix("/").unwrap_or(&video));
    assert_eq!(extract(&relative, &fixture.at(&"deep/".repeat(depth)), Some(1)).indices.len(), 1);
}

#[test]
fn sharp_frames_are_chosen() {
    let Some(fixture) = Fixture::new() else { return };
    let views = fixture.views((0..100).map(|frame| 3 * frame));
    // Every other frame is blurred: along the motion, or as out of focus.
    for blur in ["gblur=1.4:sigmaV=0:enable='not(mod(n,2))'", "gblur=1:enable='not(mod(n,2))'"] {
        let chosen = fixture.choose(&views, &["-vf", blur], 20);
        assert!(chosen.iter().all(|frame| frame % 2 == 1), "{chosen:?}");
    }
}

#[test]
fn exposure_is_no_motion_and_a_cut_is_one_stretch() {
    let Some(fixture) = Fixture::new() else { return };
    // A dark and a bright half of the range, in turns, while the camera rests.
    let exposure = ["-vf", "geq=lum='lum(X,Y)/2+12*mod(N,10)'"];
    fixture.write_video("video.mkv", &fixture.views([0; 60]), &exposure);
    for wanted in [None, Some(10)] {
        let frames = fixture.extract("video.mkv", wanted).unwrap();
        assert_eq!(frames.indices.len(), 1);
        assert_eq!(frames.warnings, ["nothing moves in the video"]);
    }

    // Two scenes of equal motion, and one at rest between them.
    let second = picture(1);
    let mut cut = fixture.views((0..50).map(|frame| 4 * frame));
    cut.extend([600; 20].into_iter().chain((0..50).map(|frame| 4 * frame)).map(|x| view(&second, x)));
    let chosen = fixture.choose(&cut, &[], 17);
    let count = |from: usize, to: usize| chosen.iter().filter(|frame| (from..to).contains(*frame)).count();
    assert_eq!(count(50, 70), 1, "{chosen:?}");
    assert!((7..=9).contains(&count(0, 50)), "{chosen:?}");
}

#[test]
fn zoom_and_roll_are_motion() {
    let Some(fixture) = Fixture::new() else { return };
    for (zoom, roll) in [(0.005, 0.), (0., 0.01)] {
        // The center of the picture stays.
        let frame = |index: i32| {
            let ((sin, cos), scale) = ((roll * index as f32).sin_cos(), 1.4 - zoom * index as f32);
            GrayImage::from_fn(WIDTH, HEIGHT, |x, y| {
                let (x, y) = ((x as f32 - 160.) * scale, (y as f32 - 90.) * scale);
                let [x, y] = [0.5 * (cos * x - sin * y) + 400., 0.5 * (sin * x + cos * y) + 90.];
                imageops::interpolate_bilinear(&fixture.picture, x, y.clamp(0., 178.)).unwrap()
            })
        };
        let frames: Vec<_> = (0..60).map(frame).collect();
        for (k, frame) in fixture.choose(&frames, &[], 6).into_iter().enumerate() {
            assert!((10 * k).saturating_sub(4) <= frame && frame < 10 * k + 14, "frame {k} is {frame}");
        }
    }
}

#[test]
fn frames_of_a_variable_rate_are_upright() {
    let Some(fixture) = Fixture::new() else { return };
    let views = fixture.views((0..20).map(|frame| 8 * frame));
    // 25 frames per second, then 5.
    fixture.write_video("video.mkv", &views, &["-vf", "settb=1/25,setpts='if(lt(N,9),N,9+(N-9)*5)'"]);
    // The option of ffmpeg 6 and later, then that of the versions before, in which it has the other sign in some.
    let by_option = ["-display_rotation", "90", "-i", "video.mkv", "-c", "copy", "rotated.mov"];
    let by_tag = ["-i", "video.mkv", "-c", "copy", "-metadata:s:v", "rotate=90", "rotated.mov"];
    assert!([&by_option[..], &by_tag].iter().any(|arguments| fixture.ffmpeg(arguments)));
    let rotation = Command::new("ffprobe")
        .args(["-v", "error", "-show_entries", "stream_side_data=rotation", "-of", "default=nk=1:nw=1"])
        .arg(fixture.at("rotated.mov"))
        .output()
        .unwrap();
    // Degrees, counterclockwise.
    let upright = match String::from_utf8(rotation.stdout).unwrap().trim() {
        "90" => imageops::rotate270,
        "-90" => imageops::rotate90,
        other => panic!("rotated by {other}"),
    };
    assert_eq!(fixture.extract("rotated.mov", Some(20)).unwrap().indices, (0..20).collect::<Vec<_>>());
    for (index, view) in views.iter().enumerate() {
        assert!(difference(fixture.frame(index), &upright(view)) < 3., "{index}");
    }
}

#[test]
fn pixels_become_square_and_colors_stay() {
    let Some(fixture) = Fixture::new() else { return };
    let colors = [[200, 40, 60], [30, 180, 70], [40, 60, 190]];
    // A large video whose colors are undeclared is BT.709, a small one is BT.601; a declaration goes first.
    for (width, height, matrix, declared) in [
        (1280, 720, "bt709", None),
        (320, 180, "bt601", None),
        (320, 180, "bt709", Some("bt709")),
        (1280, 720, "bt601", Some("smpte170m")),
    ] {
        let image = RgbImage::from_fn(width, height, |x, _| image::Rgb(colors[(x * 3 / width) as usize]));
        let size = format!("{width}x{height}");
        let filter =
            format!("loop=4:1,scale=out_color_matrix={matrix}:flags=accurate_rnd,format=yuv420p,setsar=3/2");
        let mut arguments = vec![
            "-f", "rawvideo", "-pix_fmt", "rgb24", "-r", "25", "-s", &size, "-i", "pixels", "-vf", &filter,
        ];
        arguments.extend(declared.iter().flat_map(|name| ["-colorspace", name]));
        arguments.extend(["-c:v", "ffv1", "video.mkv"]);
        fs::write(fixture.at("pixels"), image.as_raw()).unwrap();
        assert!(fixture.ffmpeg(&arguments));
        fixture.extract("video.mkv", None).unwrap();
        let shown = fixture.frame(0).into_rgb8();
        assert_eq!(shown.dimensions(), (width * 3 / 2, height));
        for (i, color) in colors.into_iter().enumerate() {
            let found = shown[(shown.width() * (2 * i as u32 + 1) / 6, height / 2)].0;
            assert!(
                found.iter().zip(color).all(|(a, b)| a.abs_diff(b) <= 4),
                "{found:?} {color:?} {matrix} {declared:?}"
            );
        }
    }
}

#[test]
fn hdr_is_converted() {
    let Some(fixture) = Fixture::new() else { return };
    // White of 100 cd/m², the diffuse white of SDR, is 51 % in PQ, a medium gray if it is taken for SDR.
    let input = ["-f", "lavfi", "-i", "color=c=0x828282:s=320x180:d=0.2:r=25", "-pix_fmt", "yuv420p10le"];
    for (transfer, range) in [("smpte2084", 145..=175), ("arib-std-b67", 115..=140)] {
        // BT.2020 is meant if nothing else is declared.
        for (primaries, matrix) in
            [("bt2020", "bt2020nc"), ("bt2020", "unknown"), ("unknown", "bt2020nc"), ("unknown", "unknown")]
        {
            let colors =
                format!("setparams=color_primaries={primaries}:color_trc={transfer}:colorspace={matrix}");
            assert!(fixture.ffmpeg(&[&input[..], &["-vf", &colors, "-c:v", "ffv1", "video.mkv"]].concat()));
            let frames = fixture.extract("video.mkv", Some(1)).unwrap();
            if let [warning] = &frames.warnings[..] {
                return skip("ffmpeg with zscale", warning);
            }
            let gray = fixture.frame(0).into_luma8()[(160, 90)].0[0];
            assert!(range.contains(&gray), "{colors}: {gray}");
        }
    }
    // A matrix that the filters don't know.
    let colors = "setparams=color_primaries=bt2020:color_trc=smpte2084:colorspace=bt2020c";
    assert!(fixture.ffmpeg(&[&input[..], &["-vf", colors, "-c:v", "ffv1", "video.mkv"]].concat()));
    let warnings = fixture.extract("video.mkv", Some(1)).unwrap().warnings;
    assert!(matches!(&warnings[..], [line] if line.ends_with("colors are pale")), "{warnings:?}");
}

#[test]
fn a_stopped_call_changes_nothing() {
    let Some(fixture) = Fixture::new() else { return };
    fixture.write_video("video.mkv", &fixture.views((0..40).map(|frame| 8 * frame)), &[]);
    let (video, folder) = (fixture.at("video.mkv"), fixture.at("made/frames"));
    for (step, done) in [(Step::Measure, 1), (Step::Measure, 30), (Step::Frames, 5)] {
        let mut go_on = |progress: Progress| progress.step != step || progress.done < done;
        assert!(extract_frames(&video, &folder, Some(20), &mut go_on).unwrap().is_none());
        assert!(!folder.exists() || names(&folder).is_empty());
    }
    // A folder with files is refused, whatever their names are.
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join("frame_00099.jpg"), "of another program").unwrap();
    let error = extract_frames(&video, &folder, Some(20), &mut |_| true).unwrap_err().to_string();
    assert!(error.contains("the folder of frames is one with frame_00099.jpg"), "{error}");
    fs::remove_file(folder.join("frame_00099.jpg")).unwrap();
    let mut seen: Vec<Progress> = vec![];
    let extracted = extract_frames(&video, &folder, Some(20), &mut |progress| {
        seen.push(progress);
        true
    });
    assert!(extracted.unwrap().is_some());
    assert_eq!(names(&folder).len(), 20);
    for (step, total) in [(Step::Measure, 40), (Step::Frames, 20)] {
        let last = seen.iter().rfind(|progress| progress.step == step);
        assert_eq!(last, Some(&Progress { step, done: total, total }));
    }
    assert_eq!(names(&fixture.at("made")).len(), 1, "nothing is left beside the folder");
}

#[test]
fn what_is_no_video_is_refused() {
    let Some(fixture) = Fixture::new() else { return };
    let at = |name: &str| fixture.at(name);
    let views = fixture.views((0..20).map(|frame| 8 * frame));
    fixture.write_video("video.mkv", &views, &[]);
    fixture.write_video("one.mkv", &views[..1], &[]);
    views[0].save(at("photo.png")).unwrap();
    views[0].save(at("photo.jpg")).unwrap();
    assert!(fixture.ffmpeg(&["-f", "lavfi", "-i", "anullsrc", "-t", "1", "sound.wav"]));
    let cover = ["-i", "sound.wav", "-i", "photo.png", "-map", "0", "-map", "1", "-c:v", "copy"];
    assert!(fixture.ffmpeg(&[&cover[..], &["-disposition:v", "attached_pic", "cover.flac"]].concat()));
    assert!(fixture.ffmpeg(&["-i", "video.mkv", "-c", "copy", "whole.mov"]));
    // The index is at the end.
    let whole = fs::read(at("whole.mov")).unwrap();
    fs::write(at("broken.mov"), &whole[..whole.len() / 2]).unwrap();
    let lenses = ["-i", "video.mkv", "-map", "0", "-map", "0", "-c", "copy", "lenses.mkv"];
    assert!(fixture.ffmpeg(&lenses));
    let thumbnail =
        ["-i", "video.mkv", "-i", "photo.jpg", "-map", "1", "-map", "0", "-c", "copy", "thumbnail.mov"];
    assert!(fixture.ffmpeg(&thumbnail));
    fs::write(at("notes.txt"), "notes of a walk\n".repeat(200)).unwrap();
    fs::write(at("noise.mp4"), (0..20_000u32).map(|i| (i * i / 8) as u8).collect::<Vec<u8>>()).unwrap();
    fs::write(at("empty.mp4"), "").unwrap();
    fs::create_dir(at("folder")).unwrap();

    for (name, expected) in [
        ("one.mkv", "the number of frames is 1, expected 2 or more"),
        ("photo.png", "the content is a photo, expected a video"),
        ("photo.jpg", "the content is a photo, expected a video"),
        ("sound.wav", "the content is sound without pictures, expected a video"),
        ("cover.flac", "the content is sound without pictures, expected a video"),
        (
            "lenses.mkv",
            "the number of picture streams is 2 of 320×180 pixels, expected 1: of a camera for 360 degrees, the stitched video, or one lens \
             by ffmpeg -i VIDEO -map 0:v:0 -c copy LENS.mkv",
        ),
        ("broken.mov", "(moov atom not found), expected a video"),
        ("noise.mp4", "), expected a video"),
        ("empty.mp4", "), expected a video"),
        ("notes.txt", "expected a video"),
        ("folder", "the path is no file, expected a video"),
    ] {
        let error = fixture.extract(name, None).unwrap_err();
        assert!(error.is_invalid_request(), "{error}");
        let (error, start) = (error.to_string(), format!("{}: ", at(name).display()));
        assert!(error.starts_with(&start) && error.ends_with(expected), "{error}");
        assert_eq!(error.lines().count(), 1);
    }
    let error = fixture.extract("none", None).unwrap_err();
    assert!(error.is_invalid_request() && error.to_string().contains("none can't be read: "), "{error}");
    for count in [0, 2001] {
        let error = fixture.extract("video.mkv", Some(count)).unwrap_err();
        assert_eq!(error.to_string(), format!("the number of frames is {count}, expected 1 to 2000"));
    }
    assert!(!at("frames").exists());
    // The only picture of one stream is a thumbnail.
    assert_eq!(fixture.extract("thumbnail.mov", Some(4)).unwrap().indices.len(), 4);
    // A video that ends early gives what it has.
    let video = fs::read(at("video.mkv")).unwrap();
    fs::write(at("short.mkv"), &video[..video.len() / 2]).unwrap();
    let summary = fixture.extract("short.mkv", Some(5)).unwrap().summary;
    assert!(!summary.contains("of 20 frames") && names(&at("frames")).len() == 5, "{summary}");
}

#[test]
fn a_missing_ffmpeg_is_reported() {
    const NAME: &str = "video::a_missing_ffmpeg_is_reported";
    if std::env::var_os("GLOBALSPLAT_TEST_WITHOUT_FFMPEG").is_none() {
        let empty = tempfile::tempdir().unwrap();
        // Like a folder that may not be entered, a file that may not be executed makes the search fail with a lack of permission.
        let denied = tempfile::tempdir().unwrap();
        fs::write(denied.path().join("ffprobe"), "not executable").unwrap();
        for path in [empty.path(), denied.path()] {
            assert!(rerun_test(NAME, &[("PATH", path), ("GLOBALSPLAT_TEST_WITHOUT_FFMPEG", path)]).0);
        }
        return;
    }
    let video = Path::new(env!("CARGO_MANIFEST_DIR")).join("README.md");
    let error = extract_frames(&video, Path::new("unused"), None, &mut |_| true).unwrap_err();
    let missing = "README.md: reading a video needs ffprobe, which isn't on the PATH (Debian and Ubuntu: apt install ffmpeg; ";
    assert!(error.is_invalid_request() && error.to_string().contains(missing), "{error}");
}
