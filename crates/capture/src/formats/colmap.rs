//! COLMAP models: `cameras` and `images`, both `.bin` or both `.txt`, with world-to-camera poses and OpenCV axes. The center of
//! pixel (0, 0) is at (½, ½), as everywhere in this crate. Points are read separately, on request (spec 10.4).

mod fields;

use super::{CaptureOpener, folder_name};
use crate::capture::{Capture, Changes, Frame, ImageLocation, Purpose};
use crate::geometry::{Camera, ImageSize};
use crate::lens::{COLMAP_MODELS, Lens, LensModel};
use crate::photos::{MASKS_FOLDER, find_masks, find_photos, format_names, natural_order, portable};
use fields::read_entries;
use glam::{DMat4, DQuat, DVec3, DVec4};
use globalsplat_files::{Error, Result};
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Folders below a capture's folder that are searched for models, directly and in numbered subfolders, each with the folders that
/// contain the model's photos. A dense model has its own photos, whose lens distortion is removed.
const PLACES: [(&str, &[&str]); 3] =
    [("sparse", &[""]), ("colmap/sparse", &["", "colmap"]), ("dense/sparse", &["dense"])];

/// Folder of numbered subfolders, and the name of the model's folder in each of them. Each subfolder also has its own photos.
const DENSE: (&str, &str) = ("dense", "sparse");

/// Name of the folder of photos.
const PHOTOS: &str = "images";

/// Files of a model.
struct Model {
    cameras: PathBuf,
    images: PathBuf,
    /// Folders that the names of the photos may be relative to.
    bases: Vec<PathBuf>,
}

impl Model {
    /// Returns the model in `folder`, the binary one if both forms exist.
    fn in_folder(folder: &Path, bases: &[PathBuf]) -> Option<Self> {
        ["bin", "txt"].into_iter().find_map(|form| {
            let file = |name: &str| Some(folder.join(format!("{name}.{form}"))).filter(|file| file.is_file());
            Some(Model { cameras: file("cameras")?, images: file("images")?, bases: bases.to_vec() })
        })
    }

    /// Returns every model of the capture in `folder`.
    fn find_all(folder: &Path) -> Vec<Self> {
        let mut models = vec![];
        let mut look = |place: &Path, bases: &[PathBuf]| {
            let places = numbered(place).into_iter().chain([place.to_owned()]);
            models.extend(places.filter_map(|place| Model::in_folder(&place, bases)));
        };
        for (place, bases) in PLACES {
            look(&folder.join(place), &bases.iter().map(|base| folder.join(base)).collect::<Vec<_>>());
        }
        for dense in numbered(&folder.join(DENSE.0)) {
            look(&dense.join(DENSE.1), std::slice::from_ref(&dense));
        }
        // The folder itself may also be a model, or the `sparse` folder of a capture.
        let canonical = folder.canonicalize().unwrap_or(folder.to_owned());
        let bases: Vec<_> = canonical.ancestors().take(3).map(Path::to_owned).collect();
        match canonical.ends_with(PLACES[0].0) {
            true => look(folder, &bases),
            false => models.extend(Model::in_folder(folder, &bases)),
        }
        models
    }
}

/// Returns the folders in `folder` whose names are numbers, in numeric order.
fn numbered(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let is_number = |path: &PathBuf| {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        !name.is_empty() && name.bytes().all(|byte| byte.is_ascii_digit()) && path.is_dir()
    };
    let mut folders: Vec<PathBuf> = entries.map(|entry| entry.path()).filter(is_number).collect();
    folders.sort_by(natural_order);
    folders
}

/// Maximum deviation of a quaternion's length from 1 that causes no warning.
const UNIT_TOLERANCE: f64 = 1e-3;

/// A camera at the origin and its lens, or (field, what was found, what was expected), which matters only if an image uses the camera.
type CameraEntry = Result<(Camera, LensModel), (String, String, String)>;

/// The first line of an image in images.txt.
struct ImageEntry {
    id: u32,
    /// World-to-camera rotation (w, x, y, z).
    quaternion: [f64; 4],
    translation: [f64; 3],
    camera: u32,
    name: String,
}

impl ImageEntry {
    /// Returns the camera-to-world matrix: the inverse of x ↦ Rx + t.
    fn c2w(&self) -> DMat4 {
        let [w, x, y, z] = self.quaternion;
        let inverse = DQuat::from_xyzw(x, y, z, w).normalize().conjugate();
        DMat4::from_rotation_translation(inverse, -(inverse * DVec3::from_array(self.translation)))
    }
}

/// Summary of a COLMAP model.
#[derive(Debug, Clone, PartialEq)]
pub struct ColmapModel {
    /// Folder of the model.
    pub folder: PathBuf,
    /// Names of the photos that have a pose.
    pub photos: Vec<String>,
    /// Camera-to-world pose of each of them.
    pub c2w: Vec<DMat4>,
    /// Positions of the points.
    pub points: Vec<DVec3>,
    /// Mean over the points of the distance between where a point is seen and where the model projects it, in pixels; 0 without points.
    pub reprojection_error: f64,
}

/// Reads the binary models in the numbered folders in `sparse`, the one with the most photos first, which [`open_capture`](crate::open_capture)
/// takes.
///
/// # Errors
/// Returns an error if a file violates the format.
pub fn read_colmap_models(sparse: &Path) -> Result<Vec<ColmapModel>> {
    let folders = numbered(sparse).into_iter().filter(|folder| folder.join("images.bin").is_file());
    let summarize = |folder: PathBuf| {
        let images = read_images(&folder.join("images.bin"))?;
        let points = read_points_with_errors(&folder.join("points3D.bin"))?;
        let errors: f64 = points.iter().map(|(_, error)| error).sum();
        let reprojection_error = errors / points.len().max(1) as f64;
        let (photos, c2w) = images.into_iter().map(|image| (image.name.clone(), image.c2w())).unzip();
        let points = points.into_iter().map(|(point, _)| point.position).collect();
        Ok(ColmapModel { folder, photos, c2w, points, reprojection_error })
    };
    let mut models = folders.map(summarize).collect::<Result<Vec<_>>>()?;
    models.sort_by_key(|model| Reverse(model.photos.len()));
    Ok(models)
}

/// Recognizes a folder that contains a model.
pub(crate) fn find(folder: &Path) -> Option<CaptureOpener> {
    let (folder, models) = (folder.to_owned(), Model::find_all(folder));
    (!models.is_empty())
        .then(|| -> CaptureOpener { Box::new(move |purpose| read_largest(&folder, &models, purpose)) })
}

/// Reads the model with the most photos among `models`, the first one in case of a tie.
fn read_largest(folder: &Path, models: &[Model], purpose: Purpose) -> Result<Capture> {
    let mut images: Vec<Result<Vec<ImageEntry>>> =
        models.iter().map(|model| read_images(&model.images)).collect();
    let sizes: Vec<Option<usize>> = images.iter().map(|images| images.as_ref().ok().map(Vec::len)).collect();
    // If no model can be read, the first one reports the error.
    let largest = (0..models.len()).rev().max_by_key(|&model| sizes[model]).expect("a model or more");
    let images = images.swap_remove(largest)?;
    let smaller = models.iter().zip(&sizes).filter(|(_, size)| **size < Some(images.len()));
    let smaller: Vec<String> = smaller
        .map(|(model, size)| {
            let place = model.images.parent().and_then(|place| place.strip_prefix(folder).ok());
            let name = place.unwrap_or(folder).display();
            match size {
                Some(size) => format!("{name} ({size} photos)"),
                None => format!("{name} (its images can't be read)"),
            }
        })
        .collect();
    let lines = (!smaller.is_empty()).then(|| {
        let (count, photos, left_out) = (models.len(), images.len(), format_names(&smaller, 3));
        format!("the largest of {count} models is taken, with {photos} photos; left out: {left_out}")
    });
    read(folder, &models[largest], images, lines.into_iter().collect(), purpose)
}

/// Reads `images` of `model` as the capture in `folder`. Frames are ordered by name, with numbers in names compared by value.
/// Frames with a missing photo are left out.
fn read(
    folder: &Path,
    model: &Model,
    images: Vec<ImageEntry>,
    lines: Vec<String>,
    purpose: Purpose,
) -> Result<Capture> {
    let mut cameras = BTreeMap::new();
    for (id, camera) in read_cameras(&model.cameras)? {
        if cameras.insert(id, camera).is_some() {
            return Err(Error::input(&model.cameras, "the camera ids", format!("{id} twice"), "each once"));
        }
    }
    let path = |name: &String| match Path::new(name).is_absolute() {
        true => name.clone(),
        false => format!("{PHOTOS}/{name}"),
    };
    let paths: Vec<String> = images.iter().map(|image| path(&image.name)).collect();
    let photos = find_photos(&model.bases, &paths);
    let masks = match purpose {
        Purpose::Photos => {
            let folders: Vec<_> = model.bases.iter().map(|base| base.join(MASKS_FOLDER)).collect();
            find_masks(&folders, &images.iter().map(|image| image.name.as_str()).collect::<Vec<_>>())
        }
        Purpose::Cameras(_) => vec![None; images.len()],
    };
    let (mut frames, mut changes) = (vec![], Changes { lines, ..Changes::default() });
    for ((image, photo), mask) in images.into_iter().zip(photos).zip(masks) {
        let (photo, declared) =
            (photo.filter(|_| !image.name.is_empty()), model.bases[0].join(PHOTOS).join(&image.name));
        let Some(photo) = changes.photo(&image.name, photo, purpose, declared) else { continue };
        let refuse = |field: &str, found: String, expected: String| {
            let field = format!("{field} of image {} ({})", image.id, image.name);
            Err(Error::input(&model.images, field, found, expected))
        };
        let (camera, lens) = match cameras.get(&image.camera) {
            Some(Ok(camera)) => *camera,
            Some(Err((field, found, expected))) => {
                return Err(Error::input(&model.cameras, field, found, expected));
            }
            None => {
                let expected = format!("one of the {} in {}", cameras.len(), model.cameras.display());
                return refuse("camera id", image.camera.to_string(), expected);
            }
        };
        let length = DVec4::from_array(image.quaternion).length();
        if !(length > 0. && length.is_finite()) {
            let expected = "a quaternion (w, x, y, z) of length 1, or of any above 0";
            return refuse("rotation", format!("{:?}", image.quaternion), expected.into());
        }
        if (length - 1.).abs() > UNIT_TOLERANCE {
            changes.scaled.push((image.name.clone(), length));
        }
        if !DVec3::from_array(image.translation).is_finite() {
            return refuse("translation", format!("{:?}", image.translation), "finite numbers".into());
        }
        let camera = Camera { c2w: image.c2w(), ..camera };
        frames.push(Frame {
            image: ImageLocation::File(photo),
            name: portable(&image.name),
            camera,
            lens,
            mask,
        });
    }
    frames.sort_by(|a, b| natural_order(&a.name, &b.name));
    Capture::new(folder_name(folder), model.images.clone(), frames, changes, purpose)
}

/// Returns the camera with the given name of its model, size and parameters.
fn camera(model: &str, sides: [(&str, u64); 2], parameters: &[f64]) -> CameraEntry {
    let side = |(name, side): (&str, u64)| match u32::try_from(side) {
        Ok(side) if side > 0 => Ok(side),
        _ => Err((name.to_string(), side.to_string(), "a number of pixels".to_string())),
    };
    let (width, height) = (side(sides[0])?, side(sides[1])?);
    let lens = Lens::from_colmap(model, parameters, ImageSize { width, height })?;
    let camera = Camera { intrinsics: lens.intrinsics, c2w: DMat4::IDENTITY, width, height };
    Ok((camera, lens.model))
}

/// Reads the entries CAMERA_ID MODEL WIDTH HEIGHT PARAMS…, and returns the cameras with their ids. The model is a name in a text file and an
/// i32 in a binary file.
fn read_cameras(file: &Path) -> Result<Vec<(u32, CameraEntry)>> {
    const MIN_ENTRY_BYTES: usize = 4 + 4 + 8 + 8 + 2 * 8;
    read_entries(file, 1, "the number of cameras", MIN_ENTRY_BYTES, |values, index| {
        let id = values.number("CAMERA_ID", || format!("the id of camera {index}, counted from 0,"))?;
        let (model, count) = match values.word() {
            Some(model) => (model, None),
            None => {
                let number: i32 = values.number("MODEL", || format!("model of camera {id}"))?;
                let model = usize::try_from(number).ok().and_then(|number| COLMAP_MODELS.get(number));
                // The number of parameters of an unknown model is unknown, and so is the start of the next camera.
                let (model, count) = model.ok_or_else(|| {
                    let expected = format!("one of {}", COLMAP_MODELS.map(|(name, _)| name).join(", "));
                    Error::input(file, format!("model of camera {id}"), format!("number {number}"), expected)
                })?;
                (*model, Some(*count))
            }
        };
        let width = values.number("WIDTH", || format!("width of camera {id}"))?;
        let height = values.number("HEIGHT", || format!("height of camera {id}"))?;
        let mut parameters = vec![];
        while count.map_or(values.has_words(), |count| parameters.len() < count) {
            parameters.push(values.number("PARAMS", || format!("the parameters of camera {id}"))?);
        }
        let camera = camera(model, [("width", width), ("height", height)], &parameters);
        Ok((
            id,
            camera.map_err(|(name, found, expected)| (format!("{name} of camera {id}"), found, expected)),
        ))
    })
}

/// Reads the entries IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, each with its points as X Y POINT3D_ID, in a line of their own in a text
/// file, which may be empty.
fn read_images(file: &Path) -> Result<Vec<ImageEntry>> {
    const POINT: usize = 24;
    const MIN_ENTRY_BYTES: usize = 4 + 7 * 8 + 4 + 1 + 8;
    read_entries(file, 2, "the number of images", MIN_ENTRY_BYTES, |values, index| {
        let id = values.number("IMAGE_ID", || format!("the id of image {index}, counted from 0,"))?;
        let pose = || format!("the pose of image {id}");
        let quaternion = values.numbers(["QW", "QX", "QY", "QZ"], pose)?;
        let translation = values.numbers(["TX", "TY", "TZ"], pose)?;
        let camera = values.number("CAMERA_ID", || format!("camera id of image {id}"))?;
        let name = values.name(|| format!("name of image {id}"))?;
        values.skip_list(|| format!("the number of points of image {id}"), POINT)?;
        Ok(ImageEntry { id, quaternion, translation, camera, name })
    })
}

/// A point on the surface of the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Position in the capture's world coordinates.
    pub position: DVec3,
    /// RGB color, values in [0, 1].
    pub color: [f32; 3],
}

/// Returns the points of the COLMAP model that `capture` was read from. Returns none if the capture has another format or the model
/// has no file of points.
///
/// # Errors
/// Fails if the file violates the format.
pub fn read_points(capture: &Capture) -> Result<Vec<Point>> {
    let images = capture.file();
    let form =
        images.file_name().and_then(|name| name.to_str()).and_then(|name| name.strip_prefix("images."));
    let file = images.with_file_name(format!("points3D.{}", form.unwrap_or_default()));
    match form {
        Some("bin" | "txt") if file.is_file() => {
            Ok(read_points_with_errors(&file)?.into_iter().map(|(point, _)| point).collect())
        }
        _ => Ok(vec![]),
    }
}

/// Reads the entries POINT3D_ID X Y Z R G B ERROR, each with the views that see the point as two ids. Returns the points and their errors.
fn read_points_with_errors(file: &Path) -> Result<Vec<(Point, f64)>> {
    const VIEW: usize = 8;
    const MIN_ENTRY_BYTES: usize = 8 + 3 * 8 + 3 + 8 + 8;
    read_entries(file, 1, "the number of points", MIN_ENTRY_BYTES, |values, index| {
        let id: u64 = values.number("POINT3D_ID", || format!("the id of point {index}, counted from 0,"))?;
        let position =
            DVec3::from_array(values.numbers(["X", "Y", "Z"], || format!("the position of point {id}"))?);
        let color: [u8; 3] = values.numbers(["R", "G", "B"], || format!("the color of point {id}"))?;
        let error = values.number("ERROR", || format!("the error of point {id}"))?;
        values.skip_list(|| format!("the number of views of point {id}"), VIEW)?;
        if !position.is_finite() {
            let (field, found) = (format!("the position of point {id}"), position.to_string());
            return Err(Error::input(file, field, found, "finite numbers"));
        }
        Ok((Point { position, color: color.map(|value| f32::from(value) / 255.) }, error))
    })
}
