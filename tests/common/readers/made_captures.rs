//! Captures in other tools' formats, generated with files of the right structure.

use super::{SIDE, file, folder, load};
use arbitrary::{Arbitrary, Unstructured};
use globalsplat::data::{open_capture, read_camera_path};
use serde_json::{Value, json};

/// Number, as Python's JSON may contain it.
#[derive(Arbitrary, Clone, Copy)]
enum Number {
    Whole(i16),
    Share(u8),
    Any(f64),
    Null,
}

impl Number {
    fn value(self) -> f64 {
        match self {
            Number::Whole(value) => value.into(),
            Number::Share(value) => f64::from(value) / 256.,
            Number::Any(value) => value,
            Number::Null => f64::NAN,
        }
    }

    /// Returns the number as JSON. NaN and infinities, which JSON lacks, become null, as the reader does with Python's spelling
    /// of them.
    fn json(self) -> Value {
        json!(self.value())
    }
}

/// Name of a photo.
#[derive(Arbitrary)]
enum Name {
    /// Name of a photo that exists.
    Photo(u8),
    Any(String),
}

impl Name {
    fn text(&self, photos: &str) -> String {
        match self {
            Name::Photo(index) => format!("{photos}{:03}.png", index % 3),
            Name::Any(name) => name.clone(),
        }
    }
}

/// Pose: a rotation about y, or arbitrary numbers.
#[derive(Arbitrary)]
enum Pose {
    Turned(u8, [i8; 3]),
    Rows(Vec<Vec<Number>>),
    Odd,
}

impl Pose {
    fn json(&self) -> Value {
        match self {
            Pose::Turned(angle, [x, y, z]) => {
                let (sin, cos) = f64::from(*angle).sin_cos();
                json!([[cos, 0, sin, x], [0, 1, 0, y], [-sin, 0, cos, z], [0, 0, 0, 1]])
            }
            Pose::Rows(rows) => {
                let row = |row: &Vec<Number>| row.iter().map(|number| number.json()).collect::<Vec<_>>();
                json!(rows.iter().map(row).collect::<Vec<_>>())
            }
            Pose::Odd => json!({"rows": 4}),
        }
    }
}

#[derive(Arbitrary)]
struct Cameras {
    shape: Option<[Number; 2]>,
    views: Vec<View>,
    /// Intrinsics fx, fy, cx and cy of the first views, which are rarely refused.
    pinholes: Vec<[Number; 4]>,
}

#[derive(Arbitrary)]
struct View {
    name: Name,
    /// Intrinsics that replace those of the photo.
    intrinsics: Option<Vec<Vec<Number>>>,
    pose: Pose,
}

/// Reads a generated `cameras.json`.
pub fn cameras(bytes: &[u8]) {
    let Ok(made) = Cameras::arbitrary(&mut Unstructured::new(bytes)) else { return };
    let side = f64::from(SIDE);
    let view = |(index, View { name, intrinsics, pose }): (usize, &View)| {
        let intrinsics = match (made.pinholes.get(index), intrinsics) {
            (Some(numbers), _) => {
                let [fx, fy, cx, cy] = numbers.each_ref().map(|number| number.json());
                json!([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            }
            (None, None) => json!([[side, 0, side / 2.], [0, side, side / 2.], [0, 0, 1]]),
            (None, Some(rows)) => Pose::Rows(rows.clone()).json(),
        };
        json!({"image": name.text("images/"), "intrinsic": intrinsics, "c2w": pose.json()})
    };
    let shape = made.shape.map_or(json!([SIDE, SIDE]), |shape| json!(shape.map(Number::json)));
    let json =
        json!({"image_shape": shape, "views": made.views.iter().enumerate().map(view).collect::<Vec<_>>()});
    let file = file("made_cameras", "cameras.json", json.to_string().as_bytes());
    let _ = open_capture(&file).map(|capture| load(&capture));
    let _ = read_camera_path(&file, None);
}

/// Description of a lens, for one frame or all.
#[derive(Arbitrary)]
struct Lens {
    numbers: Vec<(u8, Number)>,
    model: Option<(u8, String)>,
    fisheye: Option<bool>,
    coefficients: Option<Vec<Number>>,
}

const LENS: [&str; 16] = [
    "w",
    "h",
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "camera_angle_x",
    "camera_angle_y",
    "k1",
    "k2",
    "k3",
    "k4",
    "k5",
    "k6",
    "p1",
    "p2",
];
const LENS_MODELS: [&str; 10] = [
    "OPENCV",
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "RADIAL",
    "SIMPLE_RADIAL",
    "FULL_OPENCV",
    "OPENCV_FISHEYE",
    "FISHEYE624",
    "EUCM",
    "EQUIRECTANGULAR",
];

impl Lens {
    fn add_to(&self, json: &mut Value) {
        for (which, number) in &self.numbers {
            json[LENS[usize::from(*which) % LENS.len()]] = number.json();
        }
        if let Some((which, other)) = &self.model {
            let known = LENS_MODELS.get(usize::from(*which)).copied();
            json["camera_model"] = json!(known.unwrap_or(other));
        }
        if let Some(fisheye) = self.fisheye {
            json["is_fisheye"] = json!(fisheye);
        }
        if let Some(coefficients) = &self.coefficients {
            json["distortion_params"] = json!(coefficients.iter().map(|c| c.json()).collect::<Vec<_>>());
        }
    }
}

#[derive(Arbitrary)]
struct Transforms {
    lens: Option<Lens>,
    frames: Vec<(Name, Pose, Option<Lens>)>,
    /// Name lists, each with its index in [`LISTS`].
    lists: Vec<(u8, Vec<Name>)>,
}

/// Keys of the name lists.
const LISTS: [&str; 3] = ["train_filenames", "test_filenames", "val_filenames"];

/// Reads a generated `transforms.json`.
pub fn transforms(bytes: &[u8]) {
    let Ok(made) = Transforms::arbitrary(&mut Unstructured::new(bytes)) else { return };
    let mut json = json!({"w": SIDE, "h": SIDE, "fl_x": SIDE});
    if let Some(lens) = &made.lens {
        lens.add_to(&mut json);
    }
    let frame = |(name, pose, lens): &(Name, Pose, Option<Lens>)| {
        let mut frame = json!({"file_path": name.text("images/"), "transform_matrix": pose.json()});
        if let Some(lens) = lens {
            lens.add_to(&mut frame);
        }
        frame
    };
    json["frames"] = made.frames.iter().map(frame).collect();
    for (which, names) in &made.lists {
        let names = names.iter().map(|name| name.text("images/"));
        json[LISTS[usize::from(*which) % LISTS.len()]] = names.collect();
    }
    let file = file("made_transforms", "transforms.json", json.to_string().as_bytes());
    let _ = open_capture(&file).map(|capture| load(&capture));
}

#[derive(Arbitrary)]
struct Colmap {
    binary: bool,
    cameras: Vec<ColmapCamera>,
    images: Vec<ColmapImage>,
    /// Number of bytes cut from the end of either file, and bytes that overwrite some.
    cut: Option<(bool, u8)>,
    patch: Option<(bool, u16, [u8; 8])>,
}

#[derive(Arbitrary)]
struct ColmapCamera {
    id: u8,
    model: i8,
    size: Option<[u64; 2]>,
    parameters: Option<Vec<f64>>,
}

#[derive(Arbitrary)]
struct ColmapImage {
    id: u32,
    quaternion: Option<[f64; 4]>,
    translation: [i8; 3],
    camera: u8,
    name: Name,
    points: u8,
}

/// Names and parameter counts of camera models, in COLMAP's numbering.
const COLMAP_MODELS: [(&str, usize); 18] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
];

/// Indices of the models with a focal length for each axis.
const TWO_FOCAL_LENGTHS: [usize; 10] = [1, 4, 5, 6, 7, 10, 11, 13, 15, 16];

impl ColmapCamera {
    /// Returns the index of the model, and parameters that are valid for it, unless others were drawn.
    fn model(&self) -> (usize, Vec<f64>) {
        let model = usize::from(self.model.unsigned_abs()) % COLMAP_MODELS.len();
        let side = f64::from(SIDE);
        let right = [
            &[side; 2][..if TWO_FOCAL_LENGTHS.contains(&model) { 2 } else { 1 }],
            &[side / 2.; 2],
            &[0.01; 12],
        ]
        .concat();
        let right = right[..COLMAP_MODELS[model].1.min(right.len())].to_vec();
        (model, self.parameters.clone().unwrap_or(right))
    }

    fn size(&self) -> [u64; 2] {
        self.size.unwrap_or([SIDE.into(); 2])
    }
}

/// Reads both files of a generated model, binary or text.
pub fn colmap(bytes: &[u8]) {
    let Ok(made) = Colmap::arbitrary(&mut Unstructured::new(bytes)) else { return };
    let [mut cameras, mut images] = if made.binary { binary(&made) } else { texts(&made) };
    if let Some((which, count)) = made.cut {
        let file = if which { &mut cameras } else { &mut images };
        file.truncate(file.len().saturating_sub(count.into()));
    }
    if let Some((which, at, bytes)) = made.patch {
        let file = if which { &mut cameras } else { &mut images };
        let at = usize::from(at) % (file.len() + 1);
        let end = file.len().min(at + 8);
        file[at..end].copy_from_slice(&bytes[..end - at]);
    }
    let folder = folder("made_colmap");
    let (form, other) = if made.binary { ("bin", "txt") } else { ("txt", "bin") };
    for (name, contents) in [("cameras", cameras), ("images", images)] {
        file("made_colmap", &format!("sparse/0/{name}.{form}"), &contents);
        let _ = std::fs::remove_file(folder.join(format!("sparse/0/{name}.{other}")));
    }
    let _ = open_capture(&folder).map(|capture| load(&capture));
}

fn binary(made: &Colmap) -> [Vec<u8>; 2] {
    let mut cameras = (made.cameras.len() as u64).to_le_bytes().to_vec();
    for camera in &made.cameras {
        let (model, parameters) = camera.model();
        cameras.extend(u32::from(camera.id).to_le_bytes());
        cameras.extend((if camera.model < 0 { camera.model.into() } else { model as i32 }).to_le_bytes());
        cameras.extend(camera.size().iter().flat_map(|size| size.to_le_bytes()));
        cameras.extend(parameters.iter().flat_map(|value| value.to_le_bytes()));
    }
    let mut images = (made.images.len() as u64).to_le_bytes().to_vec();
    for image in &made.images {
        images.extend(image.id.to_le_bytes());
        images.extend(
            image.quaternion.unwrap_or([1., 0., 0., 0.]).iter().flat_map(|value| value.to_le_bytes()),
        );
        images.extend(image.translation.iter().flat_map(|&value| f64::from(value).to_le_bytes()));
        images.extend(u32::from(image.camera).to_le_bytes());
        images.extend(image.name.text("").as_bytes());
        images.push(0);
        images.extend(u64::from(image.points).to_le_bytes());
        images.extend(vec![1; 24 * usize::from(image.points)]);
    }
    [cameras, images]
}

fn texts(made: &Colmap) -> [Vec<u8>; 2] {
    let words = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let mut cameras = String::from("# cameras\n");
    for camera in &made.cameras {
        let (model, parameters) = camera.model();
        let ([width, height], name) = (camera.size(), COLMAP_MODELS[model].0);
        cameras += &format!("{} {name} {width} {height} {}\n", camera.id, words(&parameters));
    }
    let mut images = String::new();
    for image in &made.images {
        let pose = words(&image.quaternion.unwrap_or([1., 0., 0., 0.]));
        let translation = words(&image.translation.map(f64::from));
        images += &format!("{} {pose} {translation} {} {}\n", image.id, image.camera, image.name.text(""));
        images += &format!("{}\n", "1.5 2 -1 ".repeat(image.points.into()));
    }
    [cameras.into_bytes(), images.into_bytes()]
}
