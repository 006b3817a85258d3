//! Summaries of the models that COLMAP writes.

use globalsplat_files::{Error, Result};
use std::fs;
use std::path::{Path, PathBuf};

/// What a COLMAP model contains.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ModelSummary {
    /// Names of the photos that have a pose.
    pub names: Vec<String>,
    /// Number of points.
    pub points: usize,
    /// Mean over the points of the distance between where a point is seen and where the model projects it, in pixels.
    pub error: f64,
}

/// Reads the models in the numbered folders in `sparse`, the one with the most photos first.
///
/// # Errors
/// Returns an error if a model can't be read.
pub(crate) fn read_models(sparse: &Path) -> Result<Vec<ModelSummary>> {
    let folders = model_folders(sparse)?;
    let mut models = folders.iter().map(|folder| read_model(folder)).collect::<Result<Vec<_>>>()?;
    models.sort_by(|a, b| b.names.len().cmp(&a.names.len()).then_with(|| a.names.cmp(&b.names)));
    Ok(models)
}

/// Returns the folders in `sparse` that contain a model.
///
/// # Errors
/// Returns an error if `sparse` can't be read.
pub(crate) fn model_folders(sparse: &Path) -> Result<Vec<PathBuf>> {
    let entries = fs::read_dir(sparse).map_err(Error::read(sparse))?;
    let folders =
        entries.map(|entry| Ok(entry.map_err(Error::read(sparse))?.path())).collect::<Result<Vec<_>>>()?;
    Ok(folders.into_iter().filter(|folder| folder.join("images.bin").is_file()).collect())
}

/// Reads `images.bin` and `points3D.bin`, which COLMAP documents in "Output Format".
fn read_model(folder: &Path) -> Result<ModelSummary> {
    let [images, points] = ["images.bin", "points3D.bin"].map(|name| folder.join(name));
    let names = parse(&images, |bytes| {
        let count = bytes.number()?;
        let mut names = vec![];
        for _ in 0..count {
            // Number, quaternion, translation, camera.
            bytes.skip(4 + 7 * 8 + 4)?;
            let end = bytes.0.iter().position(|&byte| byte == 0)?;
            names.push(String::from_utf8_lossy(bytes.skip(end)?).into_owned());
            bytes.skip(1)?;
            let features = bytes.number()?;
            bytes.skip(features.checked_mul(24)?)?;
        }
        Some(names)
    })?;
    let (points, sum) = parse(&points, |bytes| {
        let count = bytes.number()?;
        let mut sum = 0.;
        for _ in 0..count {
            // Number, position, color.
            bytes.skip(8 + 3 * 8 + 3)?;
            sum += f64::from_le_bytes(bytes.skip(8)?.try_into().ok()?);
            let length = bytes.number()?;
            bytes.skip(length.checked_mul(8)?)?;
        }
        Some((count, sum))
    })?;
    Ok(ModelSummary { names, points, error: if points > 0 { sum / points as f64 } else { 0. } })
}

/// Bytes of a file that are still to be read.
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn skip(&mut self, count: usize) -> Option<&'a [u8]> {
        let (skipped, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(skipped)
    }

    fn number(&mut self) -> Option<usize> {
        usize::try_from(u64::from_le_bytes(self.skip(8)?.try_into().ok()?)).ok()
    }
}

fn parse<T>(path: &Path, read: impl FnOnce(&mut Bytes) -> Option<T>) -> Result<T> {
    let contents = fs::read(path).map_err(Error::read(path))?;
    let found = format!("cut short at {} bytes", contents.len());
    read(&mut Bytes(&contents))
        .ok_or_else(|| Error::input(path, "the model", found, "all that its counts say"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(name: &str) -> Vec<u8> {
        let mut bytes = vec![7; 4 + 7 * 8 + 4];
        bytes.extend(name.bytes().chain([0]));
        bytes.extend(1u64.to_le_bytes());
        bytes.extend([7; 24]);
        bytes
    }

    fn point(error: f64) -> Vec<u8> {
        let mut bytes = vec![7; 8 + 3 * 8 + 3];
        bytes.extend(error.to_le_bytes());
        bytes.extend(2u64.to_le_bytes());
        bytes.extend([7; 16]);
        bytes
    }

    fn write_model(folder: &Path, names: &[&str], errors: &[f64]) {
        fs::create_dir_all(folder).unwrap();
        let entries =
            |count: usize, entries: Vec<u8>| [(count as u64).to_le_bytes().to_vec(), entries].concat();
        let images = names.iter().flat_map(|name| image(name)).collect();
        let points = errors.iter().flat_map(|&error| point(error)).collect();
        fs::write(folder.join("images.bin"), entries(names.len(), images)).unwrap();
        fs::write(folder.join("points3D.bin"), entries(errors.len(), points)).unwrap();
    }

    #[test]
    fn models_are_summarized_and_the_largest_comes_first() {
        let folder = tempfile::tempdir().unwrap();
        write_model(&folder.path().join("0"), &["c.jpg"], &[]);
        write_model(&folder.path().join("1"), &["a.jpg", "sub/b.jpg"], &[0.5, 1., 1.5]);
        fs::create_dir(folder.path().join("2")).unwrap();
        let models = read_models(folder.path()).unwrap();
        let names = vec!["a.jpg".into(), "sub/b.jpg".into()];
        assert_eq!(models[0], ModelSummary { names, points: 3, error: 1. });
        assert_eq!(models[1], ModelSummary { names: vec!["c.jpg".into()], points: 0, error: 0. });
    }

    #[test]
    fn a_truncated_model_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        write_model(&folder.path().join("0"), &["a.jpg", "b.jpg"], &[0.5, 1.]);
        for name in ["images.bin", "points3D.bin"] {
            let path = folder.path().join("0").join(name);
            let whole = fs::read(&path).unwrap();
            fs::write(&path, &whole[..whole.len() - 1]).unwrap();
            let error = read_models(folder.path()).unwrap_err().to_string();
            assert!(error.contains(name) && error.contains("cut short at"), "{error}");
            fs::write(&path, whole).unwrap();
        }
    }
}
