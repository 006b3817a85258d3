//! Gaussians of a file that can't be drawn, which are either refused, or left out and counted (spec 10.9).

use crate::error::{Error, Result};
use crate::scene::Gaussians;
use std::collections::BTreeSet;
use std::path::Path;
use tch::Tensor;

/// Maximum number of properties that a warning names.
const NAMED: usize = 6;

/// Gaussians of a file that have an invalid value, one that isn't finite or is out of its range.
#[derive(Debug, Default)]
pub(super) struct InvalidGaussians {
    rows: BTreeSet<usize>,
    properties: Vec<String>,
    /// Field, found value and expected value of the first invalid Gaussian.
    first: Option<[String; 3]>,
}

impl InvalidGaussians {
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

    /// Returns `true` if Gaussian `row` is invalid.
    pub fn contains(&self, row: usize) -> bool {
        self.rows.contains(&row)
    }

    /// Refuses the file at `path` if it has invalid Gaussians.
    ///
    /// # Errors
    /// Returns an error for the first one, which names the command that leaves them out.
    pub fn refuse(self, path: &Path) -> Result<()> {
        match self.first {
            Some([field, found, expected]) => {
                let expected = format!("{expected}; `globalsplat convert` leaves out such Gaussians");
                Err(Error::input(path, field, found, expected))
            }
            None => Ok(()),
        }
    }

    /// Removes the invalid ones from `gaussians`, which were read from `path`, and reports them in `warnings`.
    pub fn leave_out(self, path: &Path, gaussians: &Gaussians, warnings: &mut Vec<String>) -> Gaussians {
        let all = gaussians.count();
        if self.rows.is_empty() {
            return gaussians.map(Tensor::shallow_clone);
        }
        let mut names = self.properties[..self.properties.len().min(NAMED)].join(", ");
        if self.properties.len() > NAMED {
            names += &format!(" and {} more", self.properties.len() - NAMED);
        }
        warnings.push(format!(
            "{}: {} of {all} Gaussians are left out, whose numbers aren't finite or are out of range: {names}",
            path.display(),
            self.rows.len()
        ));
        let kept: Vec<i64> = (0..all).filter(|&row| !self.rows.contains(&(row as usize))).collect();
        let kept = Tensor::from_slice(&kept);
        gaussians.map(|tensor| tensor.index_select(1, &kept))
    }
}
