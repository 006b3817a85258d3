//! `transforms.json` of nerfstudio and instant-ngp: {"frames": [{"file_path", "transform_matrix" 4×4 or 3×4, camera-to-world with OpenGL
//! axes}]}, and lens parameters for all frames or for each: `w`, `h`, `fl_x`, `fl_y`, `cx`, `cy` in pixels, `camera_angle_x` and
//! `camera_angle_y` in radians, the `camera_model`, and the distortion `k1` to `k6`, `p1`, `p2` (spec 10.3). NeRF's synthetic scenes
//! have a file of this kind for each split.

use super::{CaptureOpener, file_in, folder_name, read_json};
use crate::capture::{Capture, Changes, Frame, ImageLocation, Purpose};
use crate::geometry::{Camera, ImageSize, Intrinsics, nearest_rigid_of_scaled, pose_to_rows};
use crate::lens::{COLMAP_MODELS, Distortion, Lens, LensModel};
use crate::photos::{find_photos, natural_order, portable};
use crate::pixels::read_image_size;
use glam::{DMat4, DVec4};
use globalsplat_files::{Error, Result, parent_of, write_json};
use serde_json::{Value, json};
use std::collections::HashSet;
use std::f64::consts::PI;
use std::path::{Path, PathBuf};

/// File name that identifies a capture of this format.
const FILE_NAME: &str = "transforms.json";

/// Files of NeRF's synthetic scenes: training views, and test views, of which the first existing file is used.
const TRAIN_FILE: &str = "transforms_train.json";
const TEST_FILES: [&str; 2] = ["transforms_test.json", "transforms_val.json"];

/// nerfstudio's lists of training photos, and of test photos, of which the first existing list is used.
const TRAIN_LIST: &str = "train_filenames";
const TEST_LISTS: [&str; 2] = ["test_filenames", "val_filenames"];

/// Signs of the axes of OpenGL cameras in those of OpenCV.
const OPENGL_AXES: DVec4 = DVec4::new(1., -1., -1., 1.);

/// Names of lens models that are treated in a way of their own.
const OPENCV: &str = "OPENCV";
const OPENCV_FISHEYE: &str = "OPENCV_FISHEYE";
const FULL_OPENCV: &str = "FULL_OPENCV";
const EQUIRECTANGULAR: &str = "EQUIRECTANGULAR";
/// nerfstudio's name of COLMAP's RAD_TAN_THIN_PRISM_FISHEYE.
const FISHEYE624: &str = "FISHEYE624";

/// Key of a list of coefficients.
const COEFFICIENTS: &str = "distortion_params";

/// Keys of the coefficients that nerfstudio lists as `distortion_params`, in its order.
const COEFFICIENT_KEYS: [&str; 6] = ["k1", "k2", "k3", "k4", "p1", "p2"];

/// Groups of keys that together describe one property of a frame's lens. If a frame has one key of a group, the keys shared by all
/// frames are ignored for this group.
const FAMILIES: [&[&str]; 2] = [
    &["fl_x", "fl_y", "camera_angle_x", "camera_angle_y"],
    &["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", COEFFICIENTS],
];

/// Recognizes a folder with a `transforms.json`, or with a `transforms_train.json` and optional test files, or a file
/// `transforms….json`.
pub(crate) fn find(path: &Path) -> Option<CaptureOpener> {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let is_transforms_file = path.is_file() && name.starts_with("transforms") && name.ends_with(".json");
    let file = if is_transforms_file { Some(path.to_owned()) } else { file_in(path, FILE_NAME) };
    if let Some(file) = file {
        return Some(Box::new(move |purpose| read(&file, purpose)));
    }
    let train = file_in(path, TRAIN_FILE)?;
    let others: Vec<PathBuf> = TEST_FILES.iter().filter_map(|name| file_in(path, name)).collect();
    Some(Box::new(move |purpose| {
        let capture = read(&train, purpose)?;
        let [test, unread @ ..] = others.as_slice() else { return Ok(capture) };
        let (frames, changes, _) = read_frames(test, purpose)?;
        let unread = unread.iter().map(|file| {
            let views = read_frames(file, purpose).map_or(0, |(frames, ..)| frames.len());
            let (file, taken) = (file.display(), TEST_FILES[0]);
            format!("{file}: its {views} views are left out, as {taken} has those to hold out")
        });
        Ok(capture.with_test(test, frames, changes, purpose)?.with_warnings(unread.collect()))
    }))
}

/// Reads the capture that `file` describes.
pub(crate) fn read(file: &Path, purpose: Purpose) -> Result<Capture> {
    let (frames, changes, json) = read_frames(file, purpose)?;
    let new = |frames| Capture::new(folder_name(parent_of(file)), file.to_owned(), frames, changes, purpose);
    let train = read_names(file, &json, TRAIN_LIST)?;
    let [test, validation] = TEST_LISTS.map(|key| read_names(file, &json, key));
    let mut lists = [test?, validation?].into_iter().flatten();
    let (test, unread) = (lists.next().unwrap_or_default(), lists.next().unwrap_or_default());
    // A camera path consists of all frames in order.
    if matches!(purpose, Purpose::Cameras(_)) || test.is_empty() {
        return new(frames);
    }
    let (held_out, mut rest): (Vec<_>, Vec<_>) =
        frames.into_iter().partition(|frame| test.contains(&normalize_name(&frame.name)));
    let is_other = |frame: &mut Frame| {
        let name = normalize_name(&frame.name);
        unread.contains(&name) || train.as_ref().is_some_and(|train| !train.contains(&name))
    };
    let others = rest.extract_if(.., is_other).count();
    let warnings = (others > 0).then(|| {
        let file = file.display();
        format!("{file}: {others} frames are left out, as they are neither to learn from nor held out by its lists of filenames")
    });
    Ok(new(rest)?
        .with_test(file, held_out, Changes::default(), purpose)?
        .with_warnings(warnings.into_iter().collect()))
}

/// Normalizes the name of a photo, which lists may write in several ways.
fn normalize_name(name: &str) -> String {
    portable(name).trim_start_matches("./").to_owned()
}

/// Returns the names of photos in nerfstudio's list `key`, or `None` if there is no such list.
fn read_names(file: &Path, json: &Value, key: &str) -> Result<Option<HashSet<String>>> {
    let refused = |found: String| Error::input(file, key, found, "a list of file_paths");
    match json.get(key) {
        None | Some(Value::Null) => Ok(None),
        Some(Value::Array(names)) => {
            let names: Option<_> = names.iter().map(|name| name.as_str().map(normalize_name)).collect();
            names.map(Some).ok_or_else(|| refused("no names".into()))
        }
        other => Err(refused(describe_value(other))),
    }
}

/// Reads the frames that `file` describes, ordered by name, with numbers in names compared by value. Frames with a missing image
/// are left out, as nerfstudio and instant-ngp do: users delete photos after the poses were computed. Returns the contents of the file, too.
fn read_frames(file: &Path, purpose: Purpose) -> Result<(Vec<Frame>, Changes, Value)> {
    let expected = "{\"frames\": [{\"file_path\", \"transform_matrix\"}], …}";
    let json: Value = read_json(file, "no JSON", expected)?;
    let entries = match json.get("frames") {
        Some(Value::Array(entries)) => entries,
        other => return Err(Error::input(file, "frames", describe_value(other), "a list of frames")),
    };
    let frame = |(index, frame)| Fields { file, index, frame, shared: &json, purpose };
    let fields: Vec<Fields> = entries.iter().enumerate().map(frame).collect();
    let names = fields.iter().map(Fields::file_path).collect::<Result<Vec<_>>>()?;
    let mut bases = vec![parent_of(file).to_owned()];
    bases.extend(parent_of(file).canonicalize().ok().and_then(|root| Some(root.parent()?.to_owned())));
    let photos = find_photos(&bases, &names);
    let masks = match purpose {
        Purpose::Photos => find_named_masks(&bases, &fields, &photos)?,
        Purpose::Cameras(_) => vec![None; fields.len()],
    };
    let (mut frames, mut changes) = (vec![], Changes::default());
    for (((fields, name), photo), mask) in fields.iter().zip(names).zip(photos).zip(masks) {
        let declared = parent_of(file).join(name);
        if let Some(photo) = changes.photo(name, photo, purpose, declared) {
            frames.push(Frame { mask, ..fields.frame(photo, name, &mut changes)? });
        }
    }
    frames.sort_by(|a, b| natural_order(&a.name, &b.name));
    Ok((frames, changes, json))
}

/// Looks for the masks that `fields` name below `bases`. Frames whose photo is missing have none.
///
/// # Errors
/// Fails if a mask is missing: what the user meant to leave out would count.
fn find_named_masks(
    bases: &[PathBuf],
    fields: &[Fields],
    photos: &[Option<PathBuf>],
) -> Result<Vec<Option<PathBuf>>> {
    let names = fields.iter().map(|fields| fields.path("mask_path")).collect::<Result<Vec<_>>>()?;
    if names.iter().all(Option::is_none) {
        return Ok(vec![None; fields.len()]);
    }
    let paths: Vec<&str> = names.iter().map(|name| name.unwrap_or_default()).collect();
    let mut masks = find_photos(bases, &paths);
    for (((fields, name), photo), mask) in fields.iter().zip(names).zip(photos).zip(&mut masks) {
        // Without its folder, the name of a missing mask may be that of the photo.
        *mask = mask.take().filter(|mask| photo.as_ref().is_some_and(|photo| photo != mask));
        if let (Some(name), Some(_), None) = (name, photo, mask) {
            let found = format!("{name:?}, which is missing");
            let expected = "an image, or no mask_path";
            return Err(Error::input(fields.file, fields.name("mask_path"), found, expected));
        }
    }
    Ok(masks)
}

/// Describes a value of the file for an error message.
pub(crate) fn describe_value(value: Option<&Value>) -> String {
    match value {
        None => "missing".into(),
        Some(Value::Null) => "null or NaN".into(),
        Some(Value::Array(values)) => format!("a list of {}", values.len()),
        Some(Value::Object(_)) => "an object".into(),
        Some(value) => value.to_string(),
    }
}

/// Writes cameras without distortion as a `transforms.json` at `file`, each with its own size and focal lengths. `names` name the frames.
///
/// # Errors
/// Fails if the file can't be written.
///
/// # Panics
/// Panics if the numbers of names and cameras differ.
pub fn write_transforms_json(file: &Path, names: &[String], cameras: &[Camera]) -> Result<()> {
    assert_eq!(names.len(), cameras.len(), "each camera needs one name");
    let frame = |(name, camera): (&String, &Camera)| {
        let Intrinsics { fx, fy, cx, cy } = camera.intrinsics;
        let rows = pose_to_rows(&(camera.c2w * DMat4::from_diagonal(OPENGL_AXES)));
        json!({
            "file_path": name, "w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy,
            "transform_matrix": rows.chunks(4).collect::<Vec<_>>(),
        })
    };
    let frames: Vec<_> = names.iter().zip(cameras).map(frame).collect();
    write_json(file, &json!({ "camera_model": "PINHOLE", "frames": frames }))
}

/// Returns the pose of 16 numbers, row by row, converted to OpenCV axes. OpenGL's y axis points up and its z axis backward, so
/// those two columns change sign.
pub(crate) fn from_opengl(entries: &[f64; 16]) -> DMat4 {
    let opengl = DMat4::from_cols_array(entries).transpose();
    opengl * DMat4::from_diagonal(OPENGL_AXES)
}

/// Fields of a frame, each either its own or the one shared by all frames.
struct Fields<'a> {
    file: &'a Path,
    index: usize,
    frame: &'a Value,
    shared: &'a Value,
    purpose: Purpose,
}

impl<'a> Fields<'a> {
    /// Returns the value, and its name for error messages.
    fn find(&self, key: &str) -> Option<(&'a Value, String)> {
        if let Some(value) = self.frame.get(key) {
            return Some((value, self.name(key)));
        }
        let family = FAMILIES.iter().find(|family| family.contains(&key)).copied().unwrap_or_default();
        let has_own = family.iter().any(|key| self.frame.get(key).is_some());
        let shared = self.shared.get(key).filter(|_| !has_own);
        shared.map(|value| (value, key.to_string()))
    }

    fn name(&self, key: &str) -> String {
        format!("{key} of frame {}", self.index)
    }

    /// Returns the value of `key` as `convert` reads it, or `None` if there is none.
    fn get<T>(
        &self,
        key: &str,
        expected: &str,
        convert: impl Fn(&'a Value) -> Option<T>,
    ) -> Result<Option<T>> {
        let Some((value, name)) = self.find(key) else { return Ok(None) };
        let refused = || Error::input(self.file, name, describe_value(Some(value)), expected);
        convert(value).ok_or_else(refused).map(Some)
    }

    fn number(&self, key: &str) -> Result<Option<f64>> {
        self.get(key, "a number", Value::as_f64)
    }

    /// Reads a number of pixels.
    fn size(&self, key: &str) -> Result<Option<u32>> {
        let is_size = |size: &f64| *size >= 1. && *size <= f64::from(u32::MAX) && size.fract() == 0.;
        let size = self.get(key, "a number of pixels", |value| value.as_f64().filter(is_size))?;
        Ok(size.map(|size| size as u32))
    }

    /// Computes the focal length in pixels from an angle of view over `size` pixels: size / (2 tan(angle/2)).
    fn focal_from_angle(&self, key: &str, size: u32) -> Result<Option<f64>> {
        let is_angle = |angle: &f64| *angle > 0. && *angle < PI;
        let angle = self.get(key, "an angle between 0 and π", |value| value.as_f64().filter(is_angle))?;
        Ok(angle.map(|angle| f64::from(size) / (2. * (angle / 2.).tan())))
    }

    /// Returns an error that reports the existing value `found` of `key`.
    fn refuse(&self, key: &str, found: impl std::fmt::Display, expected: &str) -> Error {
        let name = self.find(key).map_or(key.to_string(), |(_, name)| name);
        Error::input(self.file, name, found, expected)
    }

    fn file_path(&self) -> Result<&'a str> {
        self.path("file_path")?.ok_or_else(|| self.refuse_path("file_path"))
    }

    /// Returns the frame's own path `key`, or `None` if it is empty or missing.
    fn path(&self, key: &str) -> Result<Option<&'a str>> {
        match self.frame.get(key) {
            None | Some(Value::Null) => Ok(None),
            Some(Value::String(path)) => Ok(Some(path.as_str()).filter(|path| !path.is_empty())),
            Some(_) => Err(self.refuse_path(key)),
        }
    }

    fn refuse_path(&self, key: &str) -> Error {
        let found = describe_value(self.frame.get(key));
        Error::input(self.file, self.name(key), found, "the path of an image")
    }

    fn frame(&self, image: PathBuf, name: &str, changes: &mut Changes) -> Result<Frame> {
        let model = self.camera_model()?;
        let (width, height) = match (self.size("w")?, self.size("h")?) {
            (Some(width), Some(height)) => (width, height),
            _ => self.purpose.size(self.file, &format!("frame {}", self.index), read_image_size(&image))?,
        };
        let (c2w, scale) = self.c2w()?;
        if scale != 1. {
            changes.scaled.push((name.to_string(), scale));
        }
        let lens = self.lens(&model, ImageSize { height, width })?;
        let camera = Camera { intrinsics: lens.intrinsics, c2w, width, height };
        let frame = Frame::pinhole(ImageLocation::File(image), portable(name), camera);
        Ok(Frame { lens: lens.model, ..frame })
    }

    /// Returns the intrinsics. A missing focal length is computed from the angle of view if possible, otherwise it equals that of
    /// the other axis. A missing principal point is the image center.
    fn intrinsics(&self, width: u32, height: u32) -> Result<Intrinsics> {
        let focal = |length: &str, angle: &str, size: u32| match self.number(length)? {
            Some(focal) => Ok(Some(focal)),
            None => self.focal_from_angle(angle, size),
        };
        let (fx, fy) = (focal("fl_x", "camera_angle_x", width)?, focal("fl_y", "camera_angle_y", height)?);
        let (Some(fx), Some(fy)) = (fx.or(fy), fy.or(fx)) else {
            let expected = "a focal length in pixels, or camera_angle_x";
            return Err(Error::input(self.file, self.name("fl_x"), "missing", expected));
        };
        let cx = self.number("cx")?.unwrap_or(f64::from(width) / 2.);
        let cy = self.number("cy")?.unwrap_or(f64::from(height) / 2.);
        Ok(Intrinsics { fx, fy, cx, cy })
    }

    /// Returns the lens of photos of `size` that `model` names.
    fn lens(&self, model: &str, size: ImageSize) -> Result<Lens> {
        let ImageSize { width, height } = size;
        let refuse = |(name, found, expected): (String, String, String)| {
            Error::input(self.file, self.name(&name), found, expected)
        };
        if model == EQUIRECTANGULAR {
            // nerfstudio writes focal lengths of other meanings, or none.
            return Lens::from_colmap(model, &[width.into(), height.into()], size).map_err(refuse);
        }
        let intrinsics = self.intrinsics(width, height)?;
        let model = match model {
            "OPENCV_FISHEYE" | "FISHEYE" | "SIMPLE_FISHEYE" | "RADIAL_FISHEYE" | "SIMPLE_RADIAL_FISHEYE" => {
                let ([k1, k2, k3, k4, ..], tangential) = self.coefficients(model)?;
                LensModel::fisheye([k1, k2, k3, k4], tangential)
            }
            "OPENCV" | "FULL_OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "RADIAL" | "SIMPLE_RADIAL" => {
                let ([k1, k2, k3, k4, k5, k6], tangential) = self.coefficients(model)?;
                let (k4, denominator) = if model == FULL_OPENCV { (0., [k4, k5, k6]) } else { (k4, [0.; 3]) };
                LensModel::Perspective(Distortion { radial: [k1, k2, k3, k4], denominator, tangential })
            }
            model => {
                let Intrinsics { fx, fy, cx, cy } = intrinsics;
                let name = if model == FISHEYE624 { "RAD_TAN_THIN_PRISM_FISHEYE" } else { model };
                let parameters = [vec![fx, fy, cx, cy], self.list()?.unwrap_or_default()].concat();
                return Lens::from_colmap(name, &parameters, size).map_err(refuse);
            }
        };
        let lens = Lens::new(&Camera { intrinsics, c2w: DMat4::IDENTITY, width, height }, model);
        lens.check().map(|()| lens).map_err(refuse)
    }

    /// Returns the coefficients k1 to k6, and p1 and p2. `model` is the name of the lens.
    fn coefficients(&self, model: &str) -> Result<([f64; 6], [f64; 2])> {
        let list = self.list()?;
        if let Some(list) = &list
            && list.len() != COEFFICIENT_KEYS.len()
        {
            let expected = format!("{} numbers: {}", COEFFICIENT_KEYS.len(), COEFFICIENT_KEYS.join(", "));
            return Err(self.refuse(COEFFICIENTS, format!("{} numbers", list.len()), &expected));
        }
        let number = |key: &str| {
            let listed = list.as_ref().zip(COEFFICIENT_KEYS.iter().position(|known| *known == key));
            Ok::<_, Error>(self.number(key)?.or(listed.map(|(list, at)| list[at])).unwrap_or(0.))
        };
        for key in ["k5", "k6"] {
            let value = number(key)?;
            if value != 0. && model != FULL_OPENCV {
                return Err(self.refuse(key, value, "0, or FULL_OPENCV as camera_model"));
            }
        }
        let radial =
            [number("k1")?, number("k2")?, number("k3")?, number("k4")?, number("k5")?, number("k6")?];
        Ok((radial, [number("p1")?, number("p2")?]))
    }

    /// Returns the numbers of `distortion_params`, if there are any.
    fn list(&self) -> Result<Option<Vec<f64>>> {
        self.get(COEFFICIENTS, "a list of numbers", |value| {
            value.as_array()?.iter().map(Value::as_f64).collect()
        })
    }

    /// Returns the name of the lens model. instant-ngp says in `is_fisheye` that it is OpenCV's fisheye.
    fn camera_model(&self) -> Result<String> {
        let is_fisheye = self.get("is_fisheye", "true or false", Value::as_bool)?.unwrap_or(false);
        let known = || COLMAP_MODELS.iter().map(|(known, _)| *known).chain([FISHEYE624]);
        let expected = format!("one of {}", known().collect::<Vec<_>>().join(", "));
        let model = self.get("camera_model", &expected, |value| {
            let model = value.as_str()?.to_ascii_uppercase();
            known().any(|known| known == model).then_some(model)
        })?;
        let model = model.unwrap_or_else(|| OPENCV.into());
        Ok(if is_fisheye && model == OPENCV { OPENCV_FISHEYE.into() } else { model })
    }

    /// Returns `transform_matrix` with OpenCV axes, and the scale factor that was removed from its rotation.
    fn c2w(&self) -> Result<(DMat4, f64)> {
        let name = self.name("transform_matrix");
        let value = self.frame.get("transform_matrix");
        let four = |row: &'a Value| row.as_array().filter(|row| row.len() == 4);
        let rows = value.and_then(Value::as_array).filter(|rows| matches!(rows.len(), 3 | 4));
        let rows: Option<Vec<_>> = rows.and_then(|rows| rows.iter().map(four).collect());
        let Some(rows) = rows else {
            let expected = "a 4×4 matrix, or its first three rows";
            return Err(Error::input(self.file, name, describe_value(value), expected));
        };
        let mut entries = DMat4::IDENTITY.to_cols_array();
        for (i, value) in rows.into_iter().flatten().enumerate() {
            entries[i] = match value {
                Value::Null => f64::NAN,
                value => value.as_f64().ok_or_else(|| {
                    let field = format!("row {}, column {} of {name}", i / 4, i % 4);
                    Error::input(self.file, field, describe_value(Some(value)), "a number")
                })?,
            };
        }
        let c2w = from_opengl(&entries);
        nearest_rigid_of_scaled(&c2w)
            .map_err(|(found, expected)| Error::input(self.file, name, found, expected))
    }
}
