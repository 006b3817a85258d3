//! PlayCanvas' SOG, version 2 (spec 10.19): the properties of all Gaussians as lossless WebP images and a `meta.json`, together in a ZIP
//! archive (`.sog`) or as files in a folder (`meta.json`). The pixel at x, y of each image belongs to Gaussian x + width · y. The axes are
//! a PLY's.

mod container;
mod palette;

use crate::morton::morton_order;
use crate::numbers::may_hold;
use crate::rotations::{from_smallest_three, smallest_three};
use crate::splat::{bounds, logit_of_opacity};
use crate::{Error, Result, Splat, WriteOptions};
use container::{Image, Reader, encode_all, write_zip};
use palette::{Codebook, Palette};
use serde::{Deserialize, Serialize};
use serde_json::json;
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

/// Version that is read and written.
const VERSION: u64 = 2;
/// Number of centroids in a row of their image.
const CENTROIDS_PER_ROW: usize = 64;
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
    version: u64,
    #[serde(default)]
    asset: serde_json::Value,
    count: usize,
    #[serde(default)]
    antialias: bool,
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
    mins: [f64; 3],
    maxs: [f64; 3],
    files: [String; 2],
}

#[derive(Serialize, Deserialize)]
struct Files {
    files: [String; 1],
}

/// Images of indices into a codebook.
#[derive(Serialize, Deserialize)]
struct Indexed {
    codebook: Vec<f32>,
    files: [String; 1],
}

/// SH coefficients above degree 0: the image of the centroids, and that of each Gaussian's centroid.
#[derive(Serialize, Deserialize)]
struct Rest {
    count: usize,
    bands: usize,
    codebook: Vec<f32>,
    files: [String; 2],
}

/// Returns `true` if `bytes` are a ZIP archive, which no other format is.
pub(crate) fn recognizes(bytes: &[u8]) -> bool {
    bytes.starts_with(b"PK\x03\x04")
}

/// Reads a `.sog`.
pub(crate) fn read_bundle(path: &Path, bytes: &[u8]) -> Result<Splat> {
    let mut reader = Reader::open_zip(path, bytes)?;
    let meta = reader.file("meta.json")?;
    read(path, reader, &meta)
}

/// Reads the `meta.json` of a folder, and the images beside it.
pub(crate) fn read_folder(path: &Path, bytes: &[u8]) -> Result<Splat> {
    read(path, Reader::open_folder(path), bytes)
}

fn read(path: &Path, mut reader: Reader, meta: &[u8]) -> Result<Splat> {
    let refuse = |field: &str, found: String, expected: &str| Err(Error::input(path, field, found, expected));
    let bad_json = |what: &str, why, expected: &str| {
        Error::input(path, "meta.json", format!("{what} ({why})"), expected)
    };
    let value: serde_json::Value =
        serde_json::from_slice(meta).map_err(|why| bad_json("no JSON", why, "the JSON of a SOG"))?;
    let version = value.get("version").map_or("missing".into(), ToString::to_string);
    if version != VERSION.to_string() {
        return refuse("the version in meta.json", version, "2, the version of SOG");
    }
    let meta: Meta = serde_json::from_value(value)
        .map_err(|why| bad_json("incomplete", why, "the entries of a SOG of version 2"))?;
    let [lower_name, upper_name] = &meta.means.files;
    let mut image = |name: &str| -> Result<Image> {
        let image = reader.image(name, |pixels, bytes| {
            // The lower bytes of positions hardly compress, and all other images have as many pixels.
            let is_small = name != lower_name || may_hold(bytes, 4 * pixels as u128);
            is_small && pixels / MAX_PIXELS.0 <= meta.count.saturating_add(MAX_PIXELS.1)
        })?;
        if image.pixels.len() < meta.count {
            let expected = format!("{} or more, one for each Gaussian", meta.count);
            let field = format!("the number of pixels of {name}");
            return Err(Error::input(path, field, image.pixels.len(), expected));
        }
        Ok(image)
    };
    let [lower, upper] = [image(lower_name)?, image(upper_name)?];
    let [scales, rotations, colors] =
        [image(&meta.scales.files[0])?, image(&meta.quats.files[0])?, image(&meta.sh0.files[0])?];
    let labels = meta.sh_rest.as_ref().map(|rest| image(&rest.files[1])).transpose()?;
    let mut splat = Splat { antialiased: meta.antialias, ..Splat::default() };
    // Values of the three indices in a pixel of the image `name`.
    let look_up = |codebook: &[f32], name: &str, pixel: [u8; 4]| -> Result<[f32; 3]> {
        let mut values = [0.; 3];
        for (value, index) in values.iter_mut().zip(pixel) {
            *value = *codebook.get(usize::from(index)).ok_or_else(|| {
                let expected = format!("less than {}, the length of the codebook", codebook.len());
                Error::input(path, format!("an index in {name}"), index, expected)
            })?;
        }
        Ok(values)
    };
    let coordinate = |axis: usize, lower: u8, upper: u8| {
        let (min, max) = (meta.means.mins[axis], meta.means.maxs[axis]);
        let value = min + (max - min) * f64::from(u16::from_le_bytes([lower, upper])) / f64::from(u16::MAX);
        (value.signum() * value.abs().exp_m1()) as f32
    };
    for index in 0..meta.count {
        let (lower, upper) = (lower.pixels[index], upper.pixels[index]);
        splat.means.push([0, 1, 2].map(|axis| coordinate(axis, lower[axis], upper[axis])));
        splat.log_scales.push(look_up(&meta.scales.codebook, &meta.scales.files[0], scales.pixels[index])?);
        let [a, b, c, mode] = rotations.pixels[index];
        let fractions = [a, b, c].map(|byte| f64::from(byte) / 255.);
        splat.quaternions.push(match mode.checked_sub(FIRST_MODE) {
            Some(largest) => from_smallest_three(largest.into(), fractions),
            None => [f32::NAN; 4],
        });
        splat.sh.push(look_up(&meta.sh0.codebook, &meta.sh0.files[0], colors.pixels[index])?);
        splat.opacity_logits.push(logit_of_opacity(f64::from(colors.pixels[index][3]) / 255.));
    }
    if let (Some(rest), Some(labels)) = (&meta.sh_rest, labels) {
        if !(1..=3).contains(&rest.bands) {
            return refuse("shN.bands", rest.bands.to_string(), "1 to 3");
        }
        if !(1..=MAX_CENTROIDS).contains(&rest.count) {
            return refuse("shN.count", rest.count.to_string(), "1 to 65536");
        }
        let coefficients = (rest.bands + 1).pow(2) - 1;
        let name = &rest.files[0];
        let centroids =
            reader.image(name, |pixels, _| pixels <= (MAX_CENTROIDS + CENTROIDS_PER_ROW) * coefficients)?;
        if centroids.width != CENTROIDS_PER_ROW * coefficients {
            let expected = format!("{} for degree {}", CENTROIDS_PER_ROW * coefficients, rest.bands);
            return refuse(&format!("the width of {name}"), centroids.width.to_string(), &expected);
        }
        if centroids.pixels.len() < rest.count * coefficients {
            let found = format!("{} pixels", centroids.pixels.len());
            return refuse(name, found, &format!("{coefficients} for each of {} centroids", rest.count));
        }
        let mut sh = Vec::with_capacity(meta.count * (coefficients + 1));
        for (color, label) in splat.sh.iter().zip(&labels.pixels) {
            let label = usize::from(u16::from_le_bytes([label[0], label[1]]));
            if label >= rest.count {
                let expected = format!("less than {}, the number of centroids", rest.count);
                return refuse(&format!("an index in {}", rest.files[1]), label.to_string(), &expected);
            }
            sh.push(*color);
            for &pixel in &centroids.pixels[label * coefficients..][..coefficients] {
                sh.push(look_up(&rest.codebook, name, pixel)?);
            }
        }
        (splat.sh, splat.sh_degree) = (sh, rest.bands);
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
        Rest { count, bands: splat.sh_degree, codebook: codebook.values, files }
    });
    let name = |name: &str| [name.to_owned()];
    let meta = Meta {
        version: VERSION,
        asset: json!({"generator": concat!("globalsplat ", env!("CARGO_PKG_VERSION"))}),
        count: splat.len(),
        antialias: splat.antialiased,
        means: Means { mins, maxs, files: ["means_l.webp", "means_u.webp"].map(String::from) },
        scales: Indexed { codebook: scales.values, files: name("scales.webp") },
        quats: Files { files: name("quats.webp") },
        sh0: Indexed { codebook: colors.values, files: name("sh0.webp") },
        sh_rest,
    };
    (serde_json::to_vec(&meta).expect("numbers and strings"), images)
}
