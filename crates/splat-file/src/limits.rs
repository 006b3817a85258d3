//! Ranges of the spherical harmonics that formats and viewers can represent.

use crate::SH_C0;
use std::ops::RangeInclusive;

/// Range of SH coefficients that a file format or a viewer supports.
#[derive(Debug, Clone, PartialEq)]
pub struct ShLimits {
    /// Maximum degree of the spherical harmonics.
    pub degree: usize,
    /// Range of the coefficients of degree 0 (`f_dc_*` in a PLY).
    pub dc: RangeInclusive<f64>,
    /// Range of the coefficients of all higher degrees (`f_rest_*` in a PLY).
    pub rest: RangeInclusive<f64>,
}

impl ShLimits {
    /// Returns limits that allow any value up to `degree`.
    pub fn up_to(degree: usize) -> Self {
        ShLimits { degree, dc: f64::MIN..=f64::MAX, rest: f64::MIN..=f64::MAX }
    }

    /// Returns the limits of browser viewers, which apply to any file format: Spark and Babylon.js store the view-independent color of a
    /// Gaussian in [0, 1] and the other coefficients within ±1, one byte each.
    pub fn of_viewers(degree: usize) -> Self {
        let dc = 0.5 / SH_C0;
        ShLimits { degree, dc: -dc..=dc, rest: -1. ..=127. / 128. }
    }

    /// Returns the intersection of both limits.
    pub fn intersect(&self, other: &Self) -> Self {
        let both = |a: &RangeInclusive<f64>, b: &RangeInclusive<f64>| {
            a.start().max(*b.start())..=a.end().min(*b.end())
        };
        ShLimits {
            degree: self.degree.min(other.degree),
            dc: both(&self.dc, &other.dc),
            rest: both(&self.rest, &other.rest),
        }
    }

    /// Returns the minimum and maximum of the coefficients of `basis`, counted from 0. Both are 0 beyond the maximum degree.
    pub fn range_of(&self, basis: usize) -> (f64, f64) {
        let range = if basis == 0 { &self.dc } else { &self.rest };
        if basis < (self.degree + 1).pow(2) { (*range.start(), *range.end()) } else { (0., 0.) }
    }
}
