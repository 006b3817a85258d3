//! COLMAP models: `cameras` and `images`, both `.bin` or both `.txt`, with world-to-camera poses and OpenCV axes. Pixel
//! (0, 0) has its centre at (½, ½), as everywhere here. The points are read where they are asked for
//! (spec 10.4).

mod fields;
mod points;

pub use points::{Point, points_of};

use super::natural::natural_order;
use super::{Found, folder_name};
use crate::data::capture::{Capture, Frame, Photo, Purpose};
use crate::data::pixels::Distortion;
use crate::error::{Error, Result};
use crate::scene::{Camera, Intrinsics};
use fields::{Bytes, Words, is_comment};
use glam::{DMat4, DQuat, DVec3};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Where a model is looked for below a capture's folder, and where its photos are.
const PLACES: [(&str, &str); 4] = [
    ("sparse/0", "images"),
    ("sparse", "images"),
    ("dense/0/sparse", "dense/0/images"),
    ("dense/sparse", "dense/images"),
];

/// Where the photos may be when the folder is the model itself, as `sparse` or `sparse/0` of a capture are.
const IMAGES_OF_MODEL: [&str; 3] = ["images", "../images", "../../images"];

/// Names and numbers of parameters of the camera models that are read; COLMAP numbers them in this order.
const MODELS: [(&str, usize); 5] =
    [("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8)];

/// Those that follow in COLMAP's numbering and aren't read.
const OTHER_MODELS: [&str; 6] =
    ["OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"];

/// How far a quaternion's length may be from 1.
const UNIT_TOLERANCE: f64 = 1e-3;

/// A model's files.
struct Model {
    cameras: PathBuf,
    images: PathBuf,
    photos: PathBuf,
}

impl Model {
    /// The model of the capture in `folder`; binary, if it is there in both forms.
    fn find(folder: &Path) -> Option<Self> {
        let of_model = IMAGES_OF_MODEL.into_iter().find(|photos| folder.join(photos).is_dir());
        let itself = ("", of_model.unwrap_or(IMAGES_OF_MODEL[0]));
        PLACES.into_iter().chain([itself]).find_map(|(place, photos)| {
            ["bin", "txt"].into_iter().find_map(|form| {
                let file = |name: &str| folder.join(place).join(format!("{name}.{form}"));
                let model =
                    Model { cameras: file("cameras"), images: file("images"), photos: folder.join(photos) };
                (model.cameras.is_file() && model.images.is_file()).then_some(model)
            })
        })
    }
}

/// A line of cameras.txt.
struct CameraEntry {
    id: u32,
    /// Into [`MODELS`].
    model: usize,
    width: u64,
    height: u64,
    parameters: Vec<f64>,
}

/// The first line of an image in images.txt.
struct ImageEntry {
    id: u32,
    /// (w, x, y, z), world-to-camera.
    quaternion: [f64; 4],
    translation: [f64; 3],
    camera: u32,
    name: String,
}

/// A folder with a model.
pub(super) fn find(folder: &Path) -> Option<Found> {
    let (folder, model) = (folder.to_owned(), Model::find(folder)?);
    Some(Box::new(move |purpose| read(&folder, &model, purpose)))
}

/// Reads `model` as the capture in `folder`. Frames come in the order of their names, numbers in them by value.
fn read(folder: &Path, model: &Model, purpose: Purpose) -> Result<Capture> {
    let text = model.cameras.extension().is_some_and(|form| form == "txt");
    let (cameras, images) = match text {
        true => (cameras_of_text(&model.cameras)?, images_of_text(&model.images)?),
        false => (cameras_of_bytes(&model.cameras)?, images_of_bytes(&model.images)?),
    };
    let mut lenses = BTreeMap::new();
    for camera in &cameras {
        if lenses.insert(camera.id, lens(&model.cameras, camera)?).is_some() {
            return Err(Error::input(
                &model.cameras,
                "the camera ids",
                format!("{} twice", camera.id),
                "each once",
            ));
        }
    }
    let mut frames = vec![];
    for image in images {
        let refuse = |field: &str, found: String, expected: String| {
            let field = format!("{field} of image {} ({})", image.id, image.name);
            Err(Error::input(&model.images, field, found, expected))
        };
        let Some((camera, distortion)) = lenses.get(&image.camera) else {
            let expected = format!("one of the {} in {}", lenses.len(), model.cameras.display());
            return refuse("camera id", image.camera.to_string(), expected);
        };
        let [w, x, y, z] = image.quaternion;
        let rotation = DQuat::from_xyzw(x, y, z, w);
        if !rotation.is_finite() || (rotation.length() - 1.).abs() > UNIT_TOLERANCE {
            let expected = "a quaternion (w, x, y, z) of length 1";
            return refuse("rotation", format!("{:?}", image.quaternion), expected.into());
        }
        let translation = DVec3::from_array(image.translation);
        if !translation.is_finite() {
            return refuse("translation", format!("{:?}", image.translation), "finite numbers".into());
        }
        let photo = model.photos.join(&image.name);
        if matches!(purpose, Purpose::Photos) && (image.name.is_empty() || !photo.is_file()) {
            let expected = format!("the name of an image in {}", model.photos.display());
            return refuse("name", format!("{:?}, which is not there", image.name), expected);
        }
        // The inverse of x ↦ Rx + t.
        let inverse = rotation.normalize().conjugate();
        let c2w = DMat4::from_rotation_translation(inverse, -(inverse * translation));
        let camera = Camera { c2w, ..*camera };
        frames.push(Frame { photo: Photo::File(photo), name: image.name, camera, distortion: *distortion });
    }
    frames.sort_by(|a, b| natural_order(&a.name, &b.name));
    Capture::new(folder_name(folder), model.images.clone(), frames, purpose)
}

/// The camera, at the origin, and its distortion.
fn lens(file: &Path, entry: &CameraEntry) -> Result<(Camera, Distortion)> {
    let refuse = |name: &str, found: String, expected: String| {
        Error::input(file, format!("{name} of camera {}", entry.id), found, expected)
    };
    let size = |name: &str, size: u64| match u32::try_from(size) {
        Ok(size) if size > 0 => Ok(size),
        _ => Err(refuse(name, size.to_string(), "a number of pixels".into())),
    };
    let (width, height) = (size("width", entry.width)?, size("height", entry.height)?);
    let ([fx, fy, cx, cy], k, p) = match (MODELS[entry.model].0, entry.parameters.as_slice()) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f, cx, cy], [0.; 2], [0.; 2]),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy, cx, cy], [0.; 2], [0.; 2]),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f, cx, cy], [k, 0.], [0.; 2]),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f, cx, cy], [k1, k2], [0.; 2]),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => ([fx, fy, cx, cy], [k1, k2], [p1, p2]),
        (model, parameters) => {
            let expected = format!("{} parameters for {model}", MODELS[entry.model].1);
            return Err(refuse("the parameters", format!("{parameters:?}"), expected));
        }
    };
    let intrinsics = Intrinsics { fx, fy, cx, cy };
    intrinsics.check(width, height).map_err(|(name, found, expected)| refuse(&name, found, expected))?;
    let camera = Camera { intrinsics, c2w: DMat4::IDENTITY, width, height };
    let distortion = Distortion { radial: [k[0], k[1], 0., 0.], tangential: p };
    distortion.check(&camera).map_err(|(found, expected)| refuse("the distortion", found, expected))?;
    Ok((camera, distortion))
}

fn unknown_model(file: &Path, camera: u32, model: &str) -> Error {
    let known = MODELS.map(|(name, _)| name).join(", ");
    Error::input(file, format!("model of camera {camera}"), model, format!("one of {known}"))
}

/// CAMERA_ID MODEL WIDTH HEIGHT PARAMS…
fn cameras_of_text(file: &Path) -> Result<Vec<CameraEntry>> {
    let text = std::fs::read_to_string(file).map_err(Error::read(file))?;
    let mut cameras = vec![];
    for (number, line) in (1..).zip(text.lines()).filter(|(_, line)| !is_comment(line)) {
        let mut words = Words { file, number, rest: line };
        let id = words.parse("CAMERA_ID", "a whole number")?;
        let name: String = words.parse("MODEL", "a camera model")?;
        let model = MODELS.iter().position(|(known, _)| *known == name);
        let model = model.ok_or_else(|| unknown_model(file, id, &name))?;
        let (width, height) =
            (words.parse("WIDTH", "a whole number")?, words.parse("HEIGHT", "a whole number")?);
        let mut parameters = vec![];
        while !words.rest.trim().is_empty() {
            parameters.push(words.parse("PARAMS", "a number")?);
        }
        cameras.push(CameraEntry { id, model, width, height, parameters });
    }
    Ok(cameras)
}

/// IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of POINTS2D as X Y POINT3D_ID, which may be empty.
fn images_of_text(file: &Path) -> Result<Vec<ImageEntry>> {
    let text = std::fs::read_to_string(file).map_err(Error::read(file))?;
    let mut images = vec![];
    let mut lines = (1..).zip(text.lines());
    while let Some((number, line)) = lines.next() {
        if is_comment(line) {
            continue;
        }
        let mut words = Words { file, number, rest: line };
        let id = words.parse("IMAGE_ID", "a whole number")?;
        let mut quaternion = [0.; 4];
        for (value, name) in quaternion.iter_mut().zip(["QW", "QX", "QY", "QZ"]) {
            *value = words.parse(name, "a number")?;
        }
        let mut translation = [0.; 3];
        for (value, name) in translation.iter_mut().zip(["TX", "TY", "TZ"]) {
            *value = words.parse(name, "a number")?;
        }
        let camera = words.parse("CAMERA_ID", "a whole number")?;
        // A name may have spaces.
        images.push(ImageEntry { id, quaternion, translation, camera, name: words.rest.trim().to_string() });
        // Tells where the second line was left away, as an image's own line has ten words.
        if let Some((number, points)) = lines.next()
            && points.split_whitespace().count() % 3 != 0
        {
            let found = format!("{} words", points.split_whitespace().count());
            let expected = "X, Y and POINT3D_ID of each point, or an empty line";
            return Err(Error::input(file, format!("POINTS2D in line {number}"), found, expected));
        }
    }
    Ok(images)
}

/// The number of cameras (u64), then of each: id (u32), model (i32), width and height (u64), parameters (f64).
fn cameras_of_bytes(file: &Path) -> Result<Vec<CameraEntry>> {
    const SMALLEST: usize = 4 + 4 + 8 + 8 + 3 * 8;
    let contents = std::fs::read(file).map_err(Error::read(file))?;
    let mut bytes = Bytes { file, contents: &contents, at: 0 };
    let mut cameras = vec![];
    for i in 0..bytes.count("the number of cameras", SMALLEST)? {
        let id = u32::from_le_bytes(bytes.take(|| format!("the id of camera {i}, counted from 0,"))?);
        let number = i32::from_le_bytes(bytes.take(|| format!("model of camera {id}"))?);
        let model = usize::try_from(number).ok().filter(|&model| model < MODELS.len());
        let model = model.ok_or_else(|| {
            let known =
                usize::try_from(number).ok().and_then(|n| OTHER_MODELS.get(n.checked_sub(MODELS.len())?));
            unknown_model(file, id, known.copied().unwrap_or(&format!("number {number}")))
        })?;
        let width = u64::from_le_bytes(bytes.take(|| format!("width of camera {id}"))?);
        let height = u64::from_le_bytes(bytes.take(|| format!("height of camera {id}"))?);
        let parameters =
            (0..MODELS[model].1).map(|_| bytes.number(|| format!("the parameters of camera {id}")));
        cameras.push(CameraEntry {
            id,
            model,
            width,
            height,
            parameters: parameters.collect::<Result<_>>()?,
        });
    }
    bytes.end()?;
    Ok(cameras)
}

/// The number of images (u64), then of each: id (u32), quaternion and translation (f64), camera id (u32), name (ended by a
/// 0), and the number of its points (u64), each x, y (f64) and an id (u64).
fn images_of_bytes(file: &Path) -> Result<Vec<ImageEntry>> {
    const POINT: usize = 24;
    const SMALLEST: usize = 4 + 7 * 8 + 4 + 1 + 8;
    let contents = std::fs::read(file).map_err(Error::read(file))?;
    let mut bytes = Bytes { file, contents: &contents, at: 0 };
    let mut images = vec![];
    for i in 0..bytes.count("the number of images", SMALLEST)? {
        let id = u32::from_le_bytes(bytes.take(|| format!("the id of image {i}, counted from 0,"))?);
        let mut pose = [0.; 7];
        for value in &mut pose {
            *value = bytes.number(|| format!("the pose of image {id}"))?;
        }
        let [w, x, y, z, translation @ ..] = pose;
        let camera = u32::from_le_bytes(bytes.take(|| format!("camera id of image {id}"))?);
        let name = bytes.name(|| format!("name of image {id}"))?;
        let points = bytes.count(&format!("the number of points of image {id}"), POINT)?;
        bytes.at += points * POINT;
        images.push(ImageEntry { id, quaternion: [w, x, y, z], translation, camera, name });
    }
    bytes.end()?;
    Ok(images)
}
