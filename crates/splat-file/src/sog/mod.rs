//! PlayCanvas' SOG (spec 10.19): the properties of all Gaussians as lossless WebP images and a `meta.json`, together in a ZIP archive
//! (`.sog`) or as files in a folder (`meta.json`). The pixel at x, y of each image belongs to Gaussian x + width · y. The axes are a PLY's.
//! Versions 1 and 2 are read, version 2 is written.

mod container;
mod palette;

use crate::morton::morton_order;
use crate::numbers::ClaimedGaussians;
use crate::rotations::{from_smallest_three, smallest_three};
use crate::splat::{bounds, logit_of_opacity};
use crate::{Error, Result, Splat, WriteOptions};
use container::{Image, Reader, encode_all, write_zip};
use palette::{Codebook, Palette};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::Path;

/// Names of the images that are written; those of coefficients are absent from a splat of degree 0.
pub(crate) const IMAGES: [&str; 7] = [
    "means_l.webp",
    "means_u.webp",
    "scales.webp",
    "quats.webp",
    "sh0.webp",
    "shN_centroids.webp",
    "shN_labels.webp",
];

/// Name of the file that describes the others.
pub(crate) const META: &str = "meta.json";
/// Version that is written. Files of version 1 have none.
const VERSION: u64 = 2;
/// Value of `model` of antialiased splats.
const ANTIALIASED: &str = "antialiased";
/// Number of centroids in a row of their image, and maximum number of a centroid's pixels.
const CENTROIDS_PER_ROW: usize = 64;
const MAX_COEFFICIENTS: usize = 15;
/// Alpha of a rotation whose largest component is w. For x, y and z it is one, two and three more.
const FIRST_MODE: u8 = 252;
/// Maximum number of centroids, whose indices have 16 bits, and the number up to which every Gaussian may have its own.
const MAX_CENTROIDS: usize = 1 << 16;
const MIN_CENTROIDS: usize = 1 << 10;
/// Number of Gaussians for each centroid. With fewer centroids the coefficients of strongly view-dependent splats are too coarse, with
/// more of them the centroids take more space than all other properties.
const GAUSSIANS_PER_CENTROID: usize = 3;
/// Largest magnitude of a log scale. Larger ones are clamped: they have no visible effect, but would take values of the codebook.
const MAX_LOG_SCALE: f32 = 20.;
/// Number of image pixels that are allowed in addition to one per Gaussian, as a factor and as a constant.
const MAX_PIXELS: (usize, usize) = (4, 1 << 16);

/// Contents of `meta.json`.
#[derive(Serialize, Deserialize)]
struct Meta {
    #[serde(skip_deserializing)]
    version: u64,
    #[serde(default)]
    asset: Value,
    /// Number of Gaussians, which version 1 has in the shape of the means.
    count: Option<usize>,
    antialias: Option<bool>,
    /// Kind of the splat, which splat-transform reads in place of `antialias`.
    #[serde(skip_serializing_if = "Option::is_none")]
    model: Option<String>,
    means: Means,
    scales: Indexed,
    quats: Files,
    sh0: Indexed,
    #[serde(rename = "shN", default, skip_serializing_if = "Option::is_none")]
    sh_rest: Option<Rest>,
}

/// Positions, whose range is that of sign(x) · ln(|x| + 1).
#[derive(Serialize, Deserialize)]
struct Means {
    #[serde(default, skip_serializing)]
    shape: Vec<usize>,
    mins: [f64; 3],
    maxs: [f64; 3],
    files: [String; 2],
}

#[derive(Serialize, Deserialize)]
struct Files {
    files: [String; 1],
}

/// Image of bytes that stand for values.
#[derive(Serialize, Deserialize)]
struct Indexed {
    #[serde(flatten)]
    values: Values,
    files: [String; 1],
}

/// SH coefficients above degree 0: the image of the centroids, and that of each Gaussian's centroid. Version 1 has neither count nor bands.
#[derive(Serialize, Deserialize)]
struct Rest {
    count: Option<usize>,
    bands: Option<usize>,
    #[serde(flatten)]
    values: Values,
    files: [String; 2],
}

/// Values of bytes.
#[derive(Default, Serialize, Deserialize)]
struct Values {
    #[serde(default)]
    codebook: Vec<Option<f32>>,
    /// In version 1, values of the bytes 0 and 255: a list with one for each channel, or a number for all.
    #[serde(default, skip_serializing)]
    mins: Value,
    #[serde(default, skip_serializing)]
    maxs: Value,
}

impl Values {
    /// Returns the values of the bytes of `channels` in version 1, or those of red, green and blue since version 2. `name` is that of the
    /// entry in `meta.json`.
    fn tables(&self, path: &Path, name: &str, channels: usize) -> Result<Vec<Vec<f32>>> {
        if self.codebook.is_empty() {
            let expected = "one, or in version 1 mins and maxs";
            let missing = || Error::input(path, format!("{name}.codebook"), "missing", expected);
            let bound = |bounds: &Value, channel: usize| {
                bounds.get(channel).unwrap_or(bounds).as_f64().ok_or_else(missing)
            };
            let table = |channel: usize| {
                let (min, max) = (bound(&self.mins, channel)?, bound(&self.maxs, channel)?);
                Ok((0..=255).map(|byte| (min + (max - min) * f64::from(byte) / 255.) as f32).collect())
            };
            return (0..channels).map(table).collect();
        }
        let mut codebook = self.codebook.clone();
        // As PlayCanvas' engine reads files of an early program.
        if let [first @ None, Some(second), .., Some(last)] = &mut codebook[..] {
            *first = Some(*second + (*second - *last) / 255.);
        }
        let null = |index: usize| {
            Error::input(path, format!("entry {index} of {name}.codebook"), "null", "a number")
        };
        let entries = codebook.iter().enumerate().map(|(index, entry)| entry.ok_or_else(|| null(index)));
        Ok(vec![entries.collect::<Result<_>>()?; 3])
    }
}

impl From<Codebook> for Values {
    fn from(codebook: Codebook) -> Self {
        Values { codebook: codebook.values.into_iter().map(Some).collect(), ..Values::default() }
    }
}

/// Returns `true` if `bytes` are a ZIP archive, which no other format is.
pub(crate) fn recognizes(bytes: &[u8]) -> bool {
    bytes.starts_with(b"PK\x03\x04")
}

/// Reads a `.sog`.
pub(crate) fn read_bundle(path: &Path, bytes: &[u8]) -> Result<Splat> {
    let mut reader = Reader::open_zip(path, bytes)?;
    let meta = reader.file(META)?;
    read(path, reader, &meta)
}

/// Reads the `meta.json` of a folder, and the images beside it.
pub(crate) fn read_folder(path: &Path, bytes: &[u8]) -> Result<Splat> {
    read(path, Reader::open_folder(path), bytes)
}

fn read(path: &Path, mut reader: Reader, meta: &[u8]) -> Result<Splat> {
    let refuse = |field: &str, found: String, expected: &str| Err(Error::input(path, field, found, expected));
    let bad_json =
        |what: &str, why, expected: &str| Error::input(path, META, format!("{what} ({why})"), expected);
    let value: Value =
        serde_json::from_slice(meta).map_err(|why| bad_json("no JSON", why, "the JSON of a SOG"))?;
    let is_known = |version: &&Value| version.as_f64().is_some_and(|number| number == 1. || number == 2.);
    if let Some(version) = value.get("version").filter(|version| !is_known(version)) {
        return refuse("the version in meta.json", version.to_string(), "1 or 2");
    }
    let meta: Meta =
        serde_json::from_value(value).map_err(|why| bad_json("incomplete", why, "the entries of a SOG"))?;
    let Some(count) = meta.count.or(meta.means.shape.first().copied()) else {
        return refuse("the number of Gaussians", "missing".into(), "count, or in version 1 means.shape");
    };
    let singles = [&meta.scales.files[0], &meta.quats.files[0], &meta.sh0.files[0]];
    let of_rest = meta.sh_rest.iter().flat_map(|rest| &rest.files);
    let size = reader.size(meta.means.files.iter().chain(singles).chain(of_rest))?;
    ClaimedGaussians::default().add(path, count, if meta.sh_rest.is_some() { 3 } else { 0 }, size)?;
    let mut image = |name: &str| -> Result<Image> {
        let image = reader.image(name, MAX_PIXELS.0 * (count + MAX_PIXELS.1))?;
        if image.pixels.len() < count {
            let expected = format!("{count} or more, one for each Gaussian");
            let field = format!("the number of pixels of {name}");
            return Err(Error::input(path, field, image.pixels.len(), expected));
        }
        Ok(image)
    };
    let [lower, upper] = [image(&meta.means.files[0])?, image(&meta.means.files[1])?];
    let [scale_name, rotation_name, color_name] = singles;
    let [scales, rotations, colors] = [image(scale_name)?, image(rotation_name)?, image(color_name)?];
    let labels = meta.sh_rest.as_ref().map(|rest| image(&rest.files[1])).transpose()?;
    let antialiased = meta.antialias == Some(true) || meta.model.as_deref() == Some(ANTIALIASED);
    let mut splat = Splat { antialiased, ..Splat::default() };
    // Values of the first three bytes of a pixel of the image `name`.
    let look_up = |tables: &[Vec<f32>], name: &str, pixel: [u8; 4]| -> Result<[f32; 3]> {
        let mut values = [0.; 3];
        for ((value, index), table) in values.iter_mut().zip(pixel).zip(tables) {
            *value = *table.get(usize::from(index)).ok_or_else(|| {
                let expected = format!("less than {}, the length of the codebook", table.len());
                Error::input(path, format!("an index in {name}"), index, expected)
            })?;
        }
        Ok(values)
    };
    let scale_tables = meta.scales.values.tables(path, "scales", 3)?;
    let color_tables = meta.sh0.values.tables(path, "sh0", 4)?;
    let coordinate = |axis: usize, lower: u8, upper: u8| {
        let (min, max) = (meta.means.mins[axis], meta.means.maxs[axis]);
        let value = min + (max - min) * f64::from(u16::from_le_bytes([lower, upper])) / f64::from(u16::MAX);
        (value.signum() * value.abs().exp_m1()) as f32
    };
    for index in 0..count {
        let (lower, upper) = (lower.pixels[index], upper.pixels[index]);
        splat.means.push([0, 1, 2].map(|axis| coordinate(axis, lower[axis], upper[axis])));
        splat.log_scales.push(look_up(&scale_tables, scale_name, scales.pixels[index])?);
        let [a, b, c, mode] = rotations.pixels[index];
        let fractions = [a, b, c].map(|byte| f64::from(byte) / 255.);
        splat.quaternions.push(match mode.checked_sub(FIRST_MODE) {
            Some(largest) => from_smallest_three(largest.into(), fractions),
            None => [f32::NAN; 4],
        });
        splat.sh.push(look_up(&color_tables, color_name, colors.pixels[index])?);
        let opacity = colors.pixels[index][3];
        splat.opacity_logits.push(match color_tables.get(3) {
            Some(logits) => logits[usize::from(opacity)],
            None => logit_of_opacity(f64::from(opacity) / 255.),
        });
    }
    if let (Some(rest), Some(labels)) = (&meta.sh_rest, labels) {
        let name = &rest.files[0];
        let centroids = reader.image(name, (MAX_CENTROIDS + CENTROIDS_PER_ROW) * MAX_COEFFICIENTS)?;
        let width = centroids.width;
        let coefficients_of = |bands: usize| (bands + 1).pow(2) - 1;
        let Some(bands) = (1..=3).find(|&bands| width == CENTROIDS_PER_ROW * coefficients_of(bands)) else {
            let expected = "192, 512 or 960 (SH degree 1 to 3)";
            return refuse(&format!("the width of {name}"), width.to_string(), expected);
        };
        if let Some(found) = rest.bands.filter(|&found| found != bands) {
            let expected = format!("{bands} for the width of {name}, {width}");
            return refuse("shN.bands", found.to_string(), &expected);
        }
        let coefficients = coefficients_of(bands);
        let stored = centroids.pixels.len() / coefficients;
        let centroid_count = rest.count.unwrap_or(stored);
        if centroid_count > stored {
            let expected = format!("{stored} at most, as in {name}");
            return refuse("shN.count", centroid_count.to_string(), &expected);
        }
        let tables = rest.values.tables(path, "shN", 3)?;
        let mut sh = Vec::with_capacity(count * (coefficients + 1));
        for (color, label) in splat.sh.iter().zip(&labels.pixels) {
            let label = usize::from(u16::from_le_bytes([label[0], label[1]]));
            if label >= centroid_count {
                let expected = format!("less than {centroid_count}, the number of centroids");
                return refuse(&format!("an index in {}", rest.files[1]), label.to_string(), &expected);
            }
            sh.push(*color);
            for &pixel in &centroids.pixels[label * coefficients..][..coefficients] {
                sh.push(look_up(&tables, name, pixel)?);
            }
        }
        (splat.sh, splat.sh_degree) = (sh, bands);
    }
    Ok(splat)
}

/// Writes a `.sog`.
pub(crate) fn write_bundle(path: &Path, splat: &Splat, _: &WriteOptions) -> Result<()> {
    let (meta, images) = encode(splat);
    write_zip(path, &meta, &encode_all(path, images)?)
}

/// Writes a `meta.json` and the images beside it.
pub(crate) fn write_folder(path: &Path, splat: &Splat, _: &WriteOptions) -> Result<()> {
    let (meta, images) = encode(splat);
    container::write_folder(path, &meta, &encode_all(path, images)?)
}

/// Returns the centroids of the coefficients above degree 0, with the values that they are rounded to, and labels in the order of `order`.
fn build_palette(splat: &Splat, order: &[usize]) -> (Palette, Codebook) {
    let vectors: Vec<f32> =
        order.iter().flat_map(|&index| splat.sh_of(index)[1..].as_flattened()).copied().collect();
    let size = (splat.len() / GAUSSIANS_PER_CENTROID).clamp(MIN_CENTROIDS, MAX_CENTROIDS);
    let palette = Palette::build(&vectors, 3 * (splat.bases() - 1), size);
    let codebook = Codebook::build(palette.centroids.iter().copied());
    (palette, codebook)
}

/// Returns the splat with the coefficients above degree 0 that a SOG stores for it. They are written without further rounding.
pub(crate) fn round_sh(splat: &Splat) -> Splat {
    let mut rounded = splat.clone();
    let coefficients = splat.bases() - 1;
    if coefficients > 0 {
        let order = morton_order(&splat.means);
        let (palette, codebook) = build_palette(splat, &order);
        let round = |color: &[f32; 3]| color.map(|value| codebook.values[usize::from(codebook.index(value))]);
        let centroids: Vec<[f32; 3]> = palette.centroids.as_chunks().0.iter().map(round).collect();
        for (&index, label) in order.iter().zip(palette.labels) {
            rounded.sh[index * splat.bases() + 1..][..coefficients]
                .copy_from_slice(&centroids[label as usize * coefficients..][..coefficients]);
        }
    }
    rounded
}

/// Returns the contents of `meta.json`, and the images by name. The Gaussians are in Morton order, for which images compress well.
fn encode(splat: &Splat) -> (Vec<u8>, Vec<(&'static str, Image)>) {
    let order = morton_order(&splat.means);
    let width = (splat.len() as f64).sqrt().ceil().max(1.) as usize;
    let image = |pixel: &dyn Fn(usize) -> [u8; 4]| {
        let mut pixels: Vec<_> = order.iter().map(|&index| pixel(index)).collect();
        pixels.resize(splat.len().div_ceil(width).max(1) * width, [0, 0, 0, 255]);
        Image { width, pixels }
    };
    let log = |coordinate: f32| f64::from(coordinate).signum() * f64::from(coordinate).abs().ln_1p();
    let [mins, maxs] = bounds(&splat.means).map(|bound| bound.map(log));
    let position = |index: usize| {
        [0, 1, 2].map(|axis| {
            let range = (maxs[axis] - mins[axis]).max(f64::MIN_POSITIVE);
            ((log(splat.means[index][axis]) - mins[axis]) / range * f64::from(u16::MAX)).round() as u16
        })
    };
    let bytes_of_position = |index: usize, byte: usize| {
        let [x, y, z] = position(index).map(|coordinate| coordinate.to_le_bytes()[byte]);
        [x, y, z, 255]
    };
    let log_scale = |value: f32| value.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE);
    let scales = Codebook::build(splat.log_scales.iter().flatten().map(|&value| log_scale(value)));
    let colors = Codebook::build((0..splat.len()).flat_map(|index| splat.sh_of(index)[0]));
    let scale = |index: usize| {
        let [x, y, z] = splat.log_scales[index].map(|value| scales.index(log_scale(value)));
        [x, y, z, 255]
    };
    let rotation = |index: usize| {
        let (largest, fractions) = smallest_three(splat.unit_quaternion(index));
        let [a, b, c] = fractions.map(|fraction| (fraction * 255.).round() as u8);
        [a, b, c, FIRST_MODE + largest as u8]
    };
    let color = |index: usize| {
        let [red, green, blue] = splat.sh_of(index)[0].map(|value| colors.index(value));
        [red, green, blue, (splat.opacity(index) * 255.).round() as u8]
    };
    let mut images = vec![
        ("means_l.webp", image(&|index| bytes_of_position(index, 0))),
        ("means_u.webp", image(&|index| bytes_of_position(index, 1))),
        ("scales.webp", image(&scale)),
        ("quats.webp", image(&rotation)),
        ("sh0.webp", image(&color)),
    ];
    let coefficients = splat.bases() - 1;
    let sh_rest = (coefficients > 0 && !splat.is_empty()).then(|| {
        let (palette, codebook) = build_palette(splat, &order);
        let pixel = |color: &[f32; 3]| {
            let [red, green, blue] = color.map(|value| codebook.index(value));
            [red, green, blue, 255]
        };
        let mut centroids: Vec<[u8; 4]> = palette.centroids.as_chunks().0.iter().map(pixel).collect();
        let count = centroids.len() / coefficients;
        let width = CENTROIDS_PER_ROW * coefficients;
        centroids.resize(count.div_ceil(CENTROIDS_PER_ROW) * width, [0, 0, 0, 255]);
        let mut labels = vec![0; splat.len()];
        order.iter().zip(palette.labels).for_each(|(&index, label)| labels[index] = label);
        let label = |index: usize| {
            let [low, high] = (labels[index] as u16).to_le_bytes();
            [low, high, 0, 255]
        };
        images.push(("shN_centroids.webp", Image { width, pixels: centroids }));
        images.push(("shN_labels.webp", image(&label)));
        let files = ["shN_centroids.webp", "shN_labels.webp"].map(String::from);
        Rest { count: Some(count), bands: Some(splat.sh_degree), values: codebook.into(), files }
    });
    let name = |name: &str| [name.to_owned()];
    let meta = Meta {
        version: VERSION,
        asset: json!({"generator": concat!("globalsplat ", env!("CARGO_PKG_VERSION"))}),
        count: Some(splat.len()),
        antialias: Some(splat.antialiased),
        model: splat.antialiased.then(|| ANTIALIASED.into()),
        means: Means { shape: vec![], mins, maxs, files: ["means_l.webp", "means_u.webp"].map(String::from) },
        scales: Indexed { values: scales.into(), files: name("scales.webp") },
        quats: Files { files: name("quats.webp") },
        sh0: Indexed { values: colors.into(), files: name("sh0.webp") },
        sh_rest,
    };
    (serde_json::to_vec(&meta).expect("numbers and strings"), images)
}
