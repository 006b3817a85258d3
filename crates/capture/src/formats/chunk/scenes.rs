//! Parser of a chunk's pickle. It locates scenes by byte ranges in the chunk's file.

use super::CAMERA_NUMBERS;
use globalsplat_torch_file::{Archive, Array, Dtype, Id, UnknownGlobals, Value, Values, unpickle};
use std::ops::Range;

/// Number of views that is always allowed. A chunk may refer to one image repeatedly, in a byte or two each time.
const ALWAYS_ALLOWED_VIEWS: usize = 100_000;
/// Minimum number of bytes of the file per view beyond [`ALWAYS_ALLOWED_VIEWS`]. An image with its description takes more.
const MIN_BYTES_PER_VIEW: usize = 50;

/// A posed video.
#[derive(Debug, Clone)]
pub(super) struct Scene {
    /// Key of the scene in an index.
    pub key: String,
    /// Camera values, [views, [`CAMERA_NUMBERS`]].
    cameras: Array,
    /// Byte range of each view's encoded image in the file.
    pub images: Vec<Range<usize>>,
}

impl Scene {
    /// Reads the camera values of every view from `file`.
    pub fn cameras(&self, file: &[u8]) -> Vec<f32> {
        self.cameras.to_f32(file).expect("floats inside the file, as the parser checked")
    }
}

/// Returns the scenes in `archive`, whose file contents are `bytes`.
///
/// # Errors
/// Fails if the pickle uses anything that isn't allowed, or is not a list of scenes.
pub(super) fn scenes(bytes: &[u8], archive: &Archive) -> Result<Vec<Scene>, String> {
    let values = unpickle(&mut &bytes[archive.pickle.clone()], UnknownGlobals::Refuse)?;
    let most = ALWAYS_ALLOWED_VIEWS + bytes.len() / MIN_BYTES_PER_VIEW;
    scenes_of(&values, archive, most).map_err(|why| format!("unusable ({why})"))
}

/// Parses the scenes, with `most` as the maximum number of views.
fn scenes_of(values: &Values, archive: &Archive, most: usize) -> Result<Vec<Scene>, String> {
    let Value::List(list) = values.get(values.root) else {
        return Err(format!("{}, expected a list of scenes", values.get(values.root).type_name()));
    };
    let (mut scenes, mut views) = (vec![], 0);
    for (index, &scene) in list.iter().enumerate() {
        let fields = Fields { values, archive, dict: dict(values, index, scene)?, index };
        views += fields.list("images")?.len();
        if views > most {
            return Err(format!("{views} views or more, for which the file has no room"));
        }
        scenes.push(fields.scene()?);
    }
    Ok(scenes)
}

/// Returns the keys and values of the scene.
fn dict<'v>(values: &'v Values, index: usize, scene: Id) -> Result<&'v [(Id, Id)], String> {
    match values.get(scene) {
        Value::Dict(items) => Ok(items),
        other => Err(format!("scene {index} is {}, expected a dict", other.type_name())),
    }
}

/// Entries of a scene. Every error message names the scene and the field.
struct Fields<'v, 'a> {
    values: &'v Values<'a>,
    archive: &'v Archive,
    dict: &'v [(Id, Id)],
    index: usize,
}

impl<'v, 'a> Fields<'v, 'a> {
    fn name(&self, field: &str) -> String {
        format!("{field} of scene {}", self.index)
    }

    fn get(&self, field: &str) -> Result<&'v Value<'a>, String> {
        self.values.find(self.dict, field).ok_or_else(|| format!("scene {} has no {field}", self.index))
    }

    fn list(&self, field: &str) -> Result<&'v [Id], String> {
        match self.get(field)? {
            Value::List(items) => Ok(items),
            other => {
                Err(format!("{} is {}, expected a list of tensors", self.name(field), other.type_name()))
            }
        }
    }

    fn text(&self, field: &str) -> Result<&'a str, String> {
        match self.get(field)? {
            Value::Str(text) => Ok(text),
            other => Err(format!("{} is {}, expected a string", self.name(field), other.type_name())),
        }
    }

    /// Returns `value`, which is in `field`, as an array of one or two dimensions.
    fn array(&self, field: &str, value: &Value) -> Result<Array, String> {
        let array = Array::locate(self.values, &self.archive.storages, value)
            .map_err(|why| format!("{} {why}", self.name(field)))?;
        match array.shape.len() <= 2 {
            true => Ok(array),
            false => Err(format!("{} is no plain tensor", self.name(field))),
        }
    }

    fn scene(&self) -> Result<Scene, String> {
        let images = self.list("images")?;
        let views = images.len();
        let cameras = self.array("cameras", self.get("cameras")?)?;
        if !cameras.dtype.is_float() || cameras.shape != [views, CAMERA_NUMBERS] {
            let (found, field) = (format!("{} {:?}", cameras.dtype, cameras.shape), self.name("cameras"));
            return Err(format!(
                "{field} is {found}, expected F32 [{views}, {CAMERA_NUMBERS}] for as many images"
            ));
        }
        let timestamps = self.values.find(self.dict, "timestamps");
        let timestamps = timestamps.map(|value| self.array("timestamps", value)).transpose()?;
        if let Some(Array { shape, .. }) = timestamps.filter(|timestamps| timestamps.shape != [views]) {
            let field = self.name("timestamps");
            return Err(format!("{field} has shape {shape:?}, expected [{views}] for as many images"));
        }
        let key = self.text("key")?;
        let image = |&id: &Id| match self.array("images", self.values.get(id))? {
            array if !array.is_contiguous() => Err(format!("{} is no plain tensor", self.name("images"))),
            Array { dtype: Dtype::U8, shape, bytes, .. } if shape.len() == 1 => Ok(bytes),
            Array { dtype, shape, .. } => {
                let found = format!("{dtype} {shape:?}");
                Err(format!("an image of {} is {found}, expected the bytes of a JPEG", self.name("images")))
            }
        };
        let images = images.iter().map(image).collect::<Result<_, String>>()?;
        Ok(Scene { key: key.to_string(), cameras, images })
    }
}
