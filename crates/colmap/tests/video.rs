//! Frames of videos that ffmpeg makes of a picture that moves in a known way.

use globalsplat_colmap::{Result, VideoFrames, VideoOptions, VideoPass, VideoProgress, extract_frames};
use globalsplat_test_kit::{rerun_test, skip};
use image::{GrayImage, RgbImage, imageops};
use std::collections::BTreeSet;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

const WIDTH: u32 = 320;
const HEIGHT: u32 = 180;
const FPS: f64 = 25.;

/// Returns `true` if there is an ffmpeg with ffprobe; otherwise, skips the test.
fn has_ffmpeg() -> bool {
    let is_missing = |program: &str| Command::new(program).arg("-version").output().is_err();
    let missing = ["ffmpeg", "ffprobe"].into_iter().find(|program| is_missing(program));
    missing.inspect(|program| skip("ffmpeg", &format!("{program} isn't on the PATH"))).is_none()
}

/// Runs ffmpeg in `folder` with `input` as its standard input; returns `true` if it succeeds.
fn run_ffmpeg(folder: &Path, arguments: &[&str], input: &[u8]) -> bool {
    let mut ffmpeg = Command::new("ffmpeg")
        .args(["-v", "error", "-y"])
        .args(arguments)
        .current_dir(folder)
        .stdin(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    // It doesn't read everything if an option is unknown to it.
    let _ = ffmpeg.stdin.take().unwrap().write_all(input);
    ffmpeg.wait().unwrap().success()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Writes `frames` of one size to a video in Matroska; `options` follow the input.
fn write_video(path: &Path, frames: &[GrayImage], options: &[&str]) {
    let size = format!("{}x{}", frames[0].width(), frames[0].height());
    let input = ["-f", "rawvideo", "-pix_fmt", "gray", "-r", "25", "-s", &size, "-i", "-"];
    let codec = ["-c:v", "mjpeg", "-q:v", "2", "-pix_fmt", "yuvj420p", "-f", "matroska", text(path)];
    let bytes: Vec<u8> = frames.iter().flat_map(|frame| frame.as_raw()).copied().collect();
    assert!(run_ffmpeg(path.parent().unwrap(), &[&input, options, &codec].concat(), &bytes));
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

/// Returns the part of `picture` that a camera sees whose left border is at `x`.
fn view(picture: &GrayImage, x: u32) -> GrayImage {
    imageops::crop_imm(picture, x, 0, WIDTH, HEIGHT).to_image()
}

fn extract(video: &Path, folder: &Path, frames: Option<usize>) -> Result<VideoFrames> {
    extract_frames(video, folder, &VideoOptions { frames }, |_| true)
}

/// Returns the indices of the frames in a video of constant frame rate.
fn indices(frames: &VideoFrames) -> Vec<usize> {
    frames.times.iter().map(|time| (time * FPS).round() as usize).collect()
}

/// Returns the mean absolute difference of two images in grey levels.
fn difference(a: &GrayImage, b: &GrayImage) -> f64 {
    assert_eq!(a.dimensions(), b.dimensions());
    let sum: f64 = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
    sum / a.as_raw().len() as f64
}

fn open(file: &Path) -> GrayImage {
    image::open(file).unwrap().into_luma8()
}

fn names(folder: &Path) -> BTreeSet<String> {
    let entries = fs::read_dir(folder).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

/// Returns the left borders of a camera that moves at `speeds` for a number of frames each.
fn pan(speeds: &[(u32, usize)]) -> Vec<u32> {
    let mut x = 0;
    let steps = speeds.iter().flat_map(|(speed, frames)| std::iter::repeat_n(*speed, *frames));
    steps
        .map(|speed| {
            x += speed;
            x
        })
        .collect()
}

#[test]
fn frames_are_equally_far_apart_and_a_pause_adds_none() {
    if !has_ffmpeg() {
        return;
    }
    let root = tempfile::tempdir().unwrap();
    let picture = picture(0);
    let xs = pan(&[(0, 20), (3, 40), (0, 50), (6, 40), (0, 20), (2, 30)]);
    let views: Vec<GrayImage> = xs.iter().map(|x| view(&picture, *x)).collect();
    // Names that ffmpeg would take for patterns, options or protocols.
    let (video, folder) = (root.path().join("-pan:%d.mkv"), root.path().join("frames %d"));
    write_video(&root.path().join("pan"), &views, &[]);
    fs::rename(root.path().join("pan"), &video).unwrap();

    let frames = extract(&video, &folder, Some(14)).unwrap();
    assert_eq!((frames.source_frames, frames.fps, frames.size), (200, FPS, (WIDTH, HEIGHT)));
    assert!(frames.warnings.is_empty(), "{:?}", frames.warnings);
    assert_eq!(frames.summary(), "14 of 200 frames, the sharpest of each stretch of equal motion");
    assert_eq!(frames.files.len(), 14);
    let expected: BTreeSet<String> = (1..=14).map(|number| format!("frame_{number:05}.jpg")).collect();
    assert_eq!(names(&folder), expected);
    let length = 420. / 14.;
    for (k, frame) in indices(&frames).into_iter().enumerate() {
        let x = f64::from(xs[frame]) / length;
        // Displacements are measured to a third of a pixel of 160, and the stretches lie between frames.
        assert!((k as f64 - 0.3..=k as f64 + 1.3).contains(&x), "frame {k} at {x}");
        // The file shows this frame and no other.
        let shown = open(&frames.files[k]);
        assert!(difference(&shown, &views[frame]) < 3.);
        let others = views.iter().zip(&xs).filter(|(_, x)| **x != xs[frame]);
        assert!(others.into_iter().all(|(other, _)| difference(&shown, other) > 5.));
    }
    let chosen: Vec<u32> = indices(&frames).into_iter().map(|frame| xs[frame]).collect();
    assert!(chosen.windows(2).all(|pair| f64::from(pair[1] - pair[0]) > length / 4.), "{chosen:?}");

    // 1.3 widths would be 22 frames at the usual distance.
    assert_eq!(extract(&video, &folder, None).unwrap().files.len(), 30);
    // The others of the larger number are removed.
    assert_eq!(extract(&video, &folder, Some(1)).unwrap().files.len(), 1);
    assert_eq!(names(&folder).len(), 1);

    // A relative path, which leads elsewhere from the folder of the frames.
    let depth = std::env::current_dir().unwrap().components().skip(1).count();
    let relative = Path::new(&"../".repeat(depth)).join(video.strip_prefix("/").unwrap_or(&video));
    let deep = root.path().join("deep/".repeat(depth));
    assert_eq!(extract(&relative, &deep, Some(1)).unwrap().files.len(), 1);
}

#[test]
fn sharp_frames_are_chosen() {
    if !has_ffmpeg() {
        return;
    }
    let root = tempfile::tempdir().unwrap();
    let picture = picture(0);
    // Every other frame is blurred: along the motion, or as out of focus.
    let blur: [fn(&GrayImage) -> GrayImage; 2] = [
        |view| {
            GrayImage::from_fn(WIDTH, HEIGHT, |x, y| {
                let near = (0..5).map(|i| u32::from(view[((x + i).min(WIDTH - 1), y)].0[0]));
                image::Luma([(near.sum::<u32>() / 5) as u8])
            })
        },
        |view| imageops::blur(view, 1.),
    ];
    for blur in blur {
        let views = (0..100).map(|frame| match view(&picture, 3 * frame) {
            sharp if frame % 2 == 1 => sharp,
            sharp => blur(&sharp),
        });
        let (video, folder) = (root.path().join("blur.mkv"), root.path().join("frames"));
        write_video(&video, &views.collect::<Vec<_>>(), &[]);
        let chosen = indices(&extract(&video, &folder, Some(20)).unwrap());
        assert_eq!(chosen.len(), 20);
        assert!(chosen.iter().all(|frame| frame % 2 == 1), "{chosen:?}");
    }
}

#[test]
fn exposure_is_no_motion_and_a_cut_is_one_stretch() {
    if !has_ffmpeg() {
        return;
    }
    let root = tempfile::tempdir().unwrap();
    let (first, second) = (picture(0), picture(1));
    let (video, folder) = (root.path().join("video.mkv"), root.path().join("frames"));

    // A dark and a bright half of the range, in turns, while the camera rests.
    let rest = |frame: u32| {
        let mut view = view(&first, 0);
        view.pixels_mut().for_each(|pixel| pixel.0[0] = pixel.0[0] / 2 + (frame % 10 * 12) as u8);
        view
    };
    write_video(&video, &(0..60).map(rest).collect::<Vec<_>>(), &[]);
    for wanted in [None, Some(10)] {
        let frames = extract(&video, &folder, wanted).unwrap();
        assert_eq!(frames.files.len(), 1);
        assert_eq!(frames.warnings, ["nothing moves in the video"]);
    }

    // Two scenes of equal motion, and one at rest between them.
    let cut = (0..120).map(|frame| match frame {
        0..50 => view(&first, 4 * frame),
        50..70 => view(&second, 600),
        _ => view(&second, 4 * (frame - 70)),
    });
    write_video(&video, &cut.collect::<Vec<_>>(), &[]);
    let chosen = indices(&extract(&video, &folder, Some(17)).unwrap());
    assert_eq!(chosen.len(), 17);
    let count = |from: usize, to: usize| chosen.iter().filter(|frame| (from..to).contains(*frame)).count();
    assert_eq!(count(50, 70), 1, "{chosen:?}");
    assert!((7..=9).contains(&count(0, 50)), "{chosen:?}");
}

#[test]
fn zoom_and_roll_are_motion() {
    if !has_ffmpeg() {
        return;
    }
    let root = tempfile::tempdir().unwrap();
    let (picture, video, folder) = (picture(0), root.path().join("video.mkv"), root.path().join("frames"));
    for (zoom, roll) in [(0.005, 0.), (0., 0.01)] {
        // The centre of the picture stays.
        let frame = |index: i32| {
            let ((sin, cos), scale) = ((roll * index as f32).sin_cos(), 1.4 - zoom * index as f32);
            GrayImage::from_fn(WIDTH, HEIGHT, |x, y| {
                let (x, y) = ((x as f32 - 160.) * scale, (y as f32 - 90.) * scale);
                let [x, y] = [0.5 * (cos * x - sin * y) + 400., 0.5 * (sin * x + cos * y) + 90.];
                imageops::interpolate_bilinear(&picture, x, y.clamp(0., 178.)).unwrap()
            })
        };
        write_video(&video, &(0..60).map(frame).collect::<Vec<_>>(), &[]);
        let chosen = indices(&extract(&video, &folder, Some(6)).unwrap());
        assert_eq!(chosen.len(), 6);
        for (k, frame) in chosen.into_iter().enumerate() {
            assert!((10 * k).saturating_sub(4) <= frame && frame < 10 * k + 14, "frame {k} is {frame}");
        }
    }
}

#[test]
fn times_are_those_of_a_variable_frame_rate() {
    if !has_ffmpeg() {
        return;
    }
    let root = tempfile::tempdir().unwrap();
    let (picture, video, folder) = (picture(0), root.path().join("video.mkv"), root.path().join("frames"));
    let views: Vec<GrayImage> = (0..130).map(|frame| view(&picture, 5 * frame)).collect();
    // 25 frames per second, then 5.
    write_video(&video, &views, &["-vf", "settb=1/25,setpts='if(lt(N,30),N,30+(N-30)*5)'"]);
    // ffmpeg takes more than 100 frames in a nested expression only.
    let frames = extract(&video, &folder, Some(130)).unwrap();
    assert_eq!((frames.files.len(), frames.source_frames), (130, 130));
    for (frame, time) in frames.times.iter().enumerate() {
        let expected = if frame < 30 { frame as f64 / 25. } else { (30 + (frame - 30) * 5) as f64 / 25. };
        assert!((time - expected).abs() < 2e-3, "{time} {expected}");
        assert!(difference(&open(&frames.files[frame]), &views[frame]) < 3.);
    }
}

#[test]
fn frames_are_upright() {
    if !has_ffmpeg() {
        return;
    }
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let (picture, video, folder) = (picture(0), at("video.mkv"), at("frames"));
    let views: Vec<GrayImage> = (0..20).map(|frame| view(&picture, 8 * frame)).collect();
    write_video(&video, &views, &[]);
    // The option of ffmpeg 6 and later, then that of the versions before, in which it has the other sign in some.
    let by_option = ["-display_rotation", "90", "-i", "video.mkv", "-c", "copy", "rotated.mov"];
    let by_tag = ["-i", "video.mkv", "-c", "copy", "-metadata:s:v", "rotate=90", "rotated.mov"];
    assert!([&by_option[..], &by_tag].iter().any(|arguments| run_ffmpeg(root.path(), arguments, &[])));
    let rotation = Command::new("ffprobe")
        .args(["-v", "error", "-show_entries", "stream_side_data=rotation", "-of", "default=nk=1:nw=1"])
        .arg(at("rotated.mov"))
        .output()
        .unwrap();
    // Degrees, counterclockwise.
    let upright = match String::from_utf8(rotation.stdout).unwrap().trim() {
        "90" => imageops::rotate270(&views[3]),
        "-90" => imageops::rotate90(&views[3]),
        other => panic!("rotated by {other}"),
    };
    let frames = extract(&at("rotated.mov"), &folder, Some(20)).unwrap();
    assert_eq!((frames.size, frames.files.len()), ((HEIGHT, WIDTH), 20));
    assert!(difference(&open(&frames.files[3]), &upright) < 3.);
}

#[test]
fn pixels_become_square_and_colors_stay() {
    if !has_ffmpeg() {
        return;
    }
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let (video, folder) = (at("video.mkv"), at("frames"));
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
        let mut arguments =
            vec!["-f", "rawvideo", "-pix_fmt", "rgb24", "-r", "25", "-s", &size, "-i", "-", "-vf", &filter];
        arguments.extend(declared.iter().flat_map(|name| ["-colorspace", name]));
        arguments.extend(["-c:v", "ffv1", text(&video)]);
        assert!(run_ffmpeg(root.path(), &arguments, image.as_raw()));
        let frames = extract(&video, &folder, None).unwrap();
        assert_eq!(frames.size, (width * 3 / 2, height));
        let shown = image::open(&frames.files[0]).unwrap().into_rgb8();
        assert_eq!(shown.dimensions(), frames.size);
        for (i, color) in colors.into_iter().enumerate() {
            let found = shown[(frames.size.0 * (2 * i as u32 + 1) / 6, height / 2)].0;
            assert!(
                found.iter().zip(color).all(|(a, b)| a.abs_diff(b) <= 4),
                "{found:?} {color:?} {matrix} {declared:?}"
            );
        }
    }
}

#[test]
fn hdr_is_converted() {
    if !has_ffmpeg() {
        return;
    }
    let root = tempfile::tempdir().unwrap();
    let (video, folder) = (root.path().join("video.mkv"), root.path().join("frames"));
    // White of 100 cd/m², the diffuse white of SDR, is 51 % in PQ, a medium grey if it is taken for SDR.
    let input = ["-f", "lavfi", "-i", "color=c=0x828282:s=320x180:d=0.2:r=25", "-pix_fmt", "yuv420p10le"];
    let colors = ["-vf", "setparams=color_primaries=bt2020:color_trc=smpte2084:colorspace=bt2020nc"];
    let arguments = [&input[..], &colors, &["-c:v", "ffv1", text(&video)]].concat();
    assert!(run_ffmpeg(root.path(), &arguments, &[]));
    let frames = extract(&video, &folder, Some(1)).unwrap();
    if let [warning] = &frames.warnings[..] {
        return skip("ffmpeg with zscale", warning);
    }
    let grey = open(&frames.files[0])[(160, 90)].0[0];
    assert!((145..=175).contains(&grey), "{grey}");
}

#[test]
fn a_stopped_call_changes_nothing() {
    if !has_ffmpeg() {
        return;
    }
    let root = tempfile::tempdir().unwrap();
    let (picture, video) = (picture(0), root.path().join("video.mkv"));
    let views: Vec<GrayImage> = (0..40).map(|frame| view(&picture, 8 * frame)).collect();
    write_video(&video, &views, &[]);
    let folder = root.path().join("made/frames");
    let options = VideoOptions { frames: Some(20) };
    let mut seen: Vec<VideoProgress> = vec![];
    for (pass, done) in [(VideoPass::Measure, 1), (VideoPass::Measure, 30), (VideoPass::Write, 5)] {
        let stopped = extract_frames(&video, &folder, &options, |progress| {
            progress.pass != pass || progress.done < done
        });
        let error = stopped.unwrap_err();
        assert!(!error.is_invalid_request());
        assert!(error.to_string().ends_with("video.mkv: stopped before all frames were written"), "{error}");
        assert!(!folder.exists() || names(&folder).is_empty());
    }
    // What isn't a frame stays.
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join("notes.txt"), "mine").unwrap();
    fs::write(folder.join("frame_00099.jpg"), "of an earlier call").unwrap();
    let extracted = extract_frames(&video, &folder, &options, |progress| {
        seen.push(progress);
        true
    });
    assert_eq!(extracted.unwrap().files.len(), 20);
    assert_eq!(names(&folder).len(), 21);
    assert!(folder.join("notes.txt").is_file() && folder.join("frame_00020.jpg").is_file());
    let last = |pass| *seen.iter().rfind(|progress| progress.pass == pass).unwrap();
    assert_eq!((last(VideoPass::Measure).done, last(VideoPass::Measure).total), (40, Some(40)));
    assert_eq!((last(VideoPass::Write).done, last(VideoPass::Write).total), (20, Some(20)));
    assert_eq!(names(root.path().join("made").as_path()).len(), 1, "nothing is left beside the folder");
}

#[test]
fn what_is_no_video_is_refused() {
    if !has_ffmpeg() {
        return;
    }
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let picture = picture(0);
    let views: Vec<GrayImage> = (0..20).map(|frame| view(&picture, 8 * frame)).collect();
    write_video(&at("video.mkv"), &views, &[]);
    write_video(&at("one.mkv"), &views[..1], &[]);
    views[0].save(at("photo.png")).unwrap();
    views[0].save(at("photo.jpg")).unwrap();
    let silence = ["-f", "u8", "-ar", "8000", "-i", "-", "sound.wav"];
    assert!(run_ffmpeg(root.path(), &silence, &[128; 8000]));
    let cover = ["-i", "sound.wav", "-i", "photo.png", "-map", "0", "-map", "1", "-c:v", "copy"];
    let make = |arguments: &[&str]| assert!(run_ffmpeg(root.path(), arguments, &[]));
    make(&[&cover[..], &["-disposition:v", "attached_pic", "cover.flac"]].concat());
    make(&["-i", "video.mkv", "-c", "copy", "whole.mov"]);
    // The index is at the end.
    let whole = fs::read(at("whole.mov")).unwrap();
    fs::write(at("broken.mov"), &whole[..whole.len() / 2]).unwrap();
    fs::write(at("notes.txt"), "notes of a walk\n".repeat(200)).unwrap();
    fs::write(at("noise.mp4"), (0..20_000u32).map(|i| (i * i / 8) as u8).collect::<Vec<u8>>()).unwrap();
    fs::write(at("empty.mp4"), "").unwrap();
    fs::create_dir(at("folder")).unwrap();

    let no_video = |found: &str| format!("the content is {found}, expected a video");
    for (name, expected) in [
        ("one.mkv", "the number of frames is 1, expected 2 or more".into()),
        ("photo.png", no_video("a photo")),
        ("photo.jpg", no_video("a photo")),
        ("sound.wav", no_video("sound without pictures")),
        ("cover.flac", no_video("sound without pictures")),
        ("broken.mov", "(moov atom not found), expected a video".into()),
        ("noise.mp4", "), expected a video".into()),
        ("empty.mp4", "), expected a video".into()),
        ("notes.txt", "expected a video".into()),
        ("folder", "the path is no file, expected a video".into()),
    ] {
        let error = extract(&at(name), &at("frames"), None).unwrap_err();
        assert!(error.is_invalid_request(), "{error}");
        let (error, start) = (error.to_string(), format!("{}: ", at(name).display()));
        assert!(error.starts_with(&start) && error.ends_with(&expected), "{error}");
    }
    let error = extract(&at("none"), &at("frames"), None).unwrap_err();
    assert!(error.is_invalid_request() && error.to_string().contains("none can't be read: "), "{error}");
    for frames in [0, 2001] {
        let error = extract(&at("video.mkv"), &at("frames"), Some(frames)).unwrap_err();
        assert_eq!(error.to_string(), format!("the number of frames is {frames}, expected 1 to 2000"));
    }
    // A video that ends early gives what it has.
    let video = fs::read(at("video.mkv")).unwrap();
    fs::write(at("short.mkv"), &video[..video.len() / 2]).unwrap();
    let frames = extract(&at("short.mkv"), &at("frames"), Some(5)).unwrap();
    assert!(frames.source_frames < 20 && frames.files.len() == 5, "{}", frames.source_frames);
    assert!(!at("frames").join("frame_00006.jpg").exists());
}

#[test]
fn a_missing_ffmpeg_is_reported() {
    const NAME: &str = "a_missing_ffmpeg_is_reported";
    let video = PathBuf::from(file!());
    let video = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(video.file_name().unwrap());
    if std::env::var_os("GLOBALSPLAT_TEST_WITHOUT_FFMPEG").is_none() {
        let empty = tempfile::tempdir().unwrap();
        // Like a folder that may not be entered, a file that may not be executed makes the search fail with a lack of permission.
        let denied = tempfile::tempdir().unwrap();
        fs::write(denied.path().join("ffprobe"), "not executable").unwrap();
        for path in [empty.path(), denied.path()] {
            let variables = [("PATH", path), ("GLOBALSPLAT_TEST_WITHOUT_FFMPEG", path)];
            assert!(rerun_test(NAME, &variables).0);
        }
        return;
    }
    let error = extract(&video, Path::new("unused"), None).unwrap_err();
    let missing = "video.rs: reading a video needs ffprobe, which isn't on the PATH (Debian and Ubuntu: apt install ffmpeg; ";
    assert!(error.is_invalid_request() && error.to_string().contains(missing), "{error}");
}
