//! Gaussians of a file that can't be drawn, which are either refused, or left out and counted (spec 10.9).

use crate::{Error, Result, Splat};
use std::collections::BTreeSet;
use std::path::Path;

/// Maximum number of properties that a warning names.
const NAMED: usize = 6;

/// Gaussians of a file that have an invalid value, one that isn't finite or is out of its range.
#[derive(Debug, Default)]
pub(crate) struct InvalidGaussians {
    /// Indices of the Gaussians.
    pub rows: BTreeSet<usize>,
    properties: Vec<String>,
    /// Field, found value and expected value of the first invalid Gaussian.
    first: Option<[String; 3]>,
}

impl InvalidGaussians {
    /// Finds the Gaussians of `splat` that have a value that isn't finite, or a negative scale.
    pub fn find(splat: &Splat) -> Self {
        let mut invalid = Self::default();
        for row in 0..splat.len() {
            let mut check = |property: &str, values: &[f32], min: f32| {
                if let Some(&bad) = values.iter().find(|&&value| !(value.is_finite() && value >= min)) {
                    let expected = if bad.is_finite() { "0 or more" } else { "finite numbers" };
                    invalid.add(row, property, || format!("the {property} of Gaussian {row}"), bad, expected);
                }
            };
            check("position", &splat.means[row], f32::MIN);
            check("scale", &splat.scale(row), 0.);
            check("rotation", &splat.quaternions[row], f32::MIN);
            check("opacity", &[splat.opacity(row)], 0.);
            check("color", splat.sh_of(row).as_flattened(), f32::MIN);
        }
        invalid
    }

    /// Adds Gaussian `row`, whose `property` is `found`; `field` is its name in errors.
    pub fn add(
        &mut self,
        row: usize,
        property: &str,
        field: impl FnOnce() -> String,
        found: f32,
        expected: &str,
    ) {
        self.rows.insert(row);
        if !self.properties.iter().any(|name| name == property) {
            self.properties.push(property.into());
        }
        self.first.get_or_insert_with(|| [field(), found.to_string(), expected.into()]);
    }

    /// Refuses the file at `path` if it has invalid Gaussians, with an error that names the first one and the command that leaves them out.
    pub fn refuse(self, path: &Path) -> Result<()> {
        let Some([field, found, expected]) = self.first else { return Ok(()) };
        let expected = format!("{expected}; `globalsplat convert` leaves out such Gaussians");
        Err(Error::input(path, field, found, expected))
    }

    /// Returns `splat`, which was read from `path`, without the invalid ones, and reports them in its warnings.
    pub fn leave_out(self, path: &Path, splat: Splat) -> Splat {
        if self.rows.is_empty() {
            return splat;
        }
        let mut names = self.properties[..self.properties.len().min(NAMED)].join(", ");
        if self.properties.len() > NAMED {
            names += &format!(" and {} more", self.properties.len() - NAMED);
        }
        let kept: Vec<usize> = (0..splat.len()).filter(|row| !self.rows.contains(row)).collect();
        let mut valid = splat.select(&kept);
        valid.warnings.push(format!(
            "{}: {} of {} Gaussians are left out, whose numbers aren't finite or are out of range: {names}",
            path.display(),
            self.rows.len(),
            splat.len()
        ));
        valid
    }
}
