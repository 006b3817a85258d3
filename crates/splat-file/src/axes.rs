//! Directions of coordinate axes. Formats of splats have x to the right, y down, z forward; SPZ and glTF have y up.

use crate::Splat;
use glam::{DMat4, DVec4};

/// Axes whose reversal changes the sign of a spherical harmonic, in the order of spec 6.3 from degree 1.
const ODD: [&str; 15] = ["y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x"];

/// Conversion from other axes to those to the right, down and forward.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Axes {
    /// Signs of x, y and z, which convert in both directions.
    signs: [f32; 3],
    /// `true` if y and z then become z and −y.
    is_turned: bool,
}

impl Axes {
    /// Right, up, back: the default of SPZ.
    pub const RUB: Axes = Axes { signs: [1., -1., -1.], is_turned: false };

    /// Left, up, forward: the axes of splats in glTF, half a turn about z away.
    pub const LUF: Axes = Axes { signs: [-1., -1., 1.], is_turned: false };

    /// Returns the axes with this number in the extension SPZ_ADOBE_coordinate_system: 1 to 8 are LDB, RDB, LUB, RUB, LDF, RDF, LUF and
    /// RUF, 9 to 16 the same with a quarter turn, which is how Niantic's library reads LFD, RFD, LFU, RFU, LBD, RBD, LBU and RBU; 0 is
    /// unspecified. Returns `None` for other numbers.
    pub fn from_code(number: u32) -> Option<Self> {
        let sign = |positive: bool| if positive { 1. } else { -1. };
        match number {
            0 => Some(Axes::RUB),
            1..=16 => {
                let bits = number - 1;
                let signs = [sign(bits & 1 != 0), sign(bits & 2 == 0), sign(bits & 4 != 0)];
                Some(Axes { signs, is_turned: bits & 8 != 0 })
            }
            _ => None,
        }
    }

    /// Converts the Gaussians of `splat`, exactly unless y and z are exchanged: numbers change their signs only.
    pub fn convert(self, splat: &mut Splat) {
        self.convert_without_rotations(splat);
        let [of_x, of_y, of_z] = self.signs;
        for quaternion in &mut splat.quaternions {
            let [w, x, y, z] = *quaternion;
            // The direction about an axis is reversed if exactly one of the other two axes is reversed.
            *quaternion = [w, of_y * of_z * x, of_x * of_z * y, of_x * of_y * z];
        }
        if self.is_turned {
            let quarter_turn = DMat4::from_cols(DVec4::X, DVec4::NEG_Z, DVec4::Y, DVec4::W);
            *splat = splat.transformed(&quarter_turn).expect("a rotation");
        }
    }

    /// Changes the signs of the Gaussians of `splat` like [`Axes::convert`], except for those of their rotations.
    pub fn convert_without_rotations(self, splat: &mut Splat) {
        for mean in &mut splat.means {
            *mean = std::array::from_fn(|axis| self.signs[axis] * mean[axis]);
        }
        let of_axis = |axis: char| self.signs["xyz".find(axis).expect("an axis")];
        let signs = ODD.map(|axes| axes.chars().map(of_axis).product::<f32>());
        let bases = splat.bases();
        for of_one in splat.sh.chunks_exact_mut(bases) {
            for (color, sign) in of_one[1..].iter_mut().zip(signs) {
                *color = color.map(|channel| sign * channel);
            }
        }
    }
}
