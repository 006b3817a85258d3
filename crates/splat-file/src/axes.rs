//! Directions of coordinate axes. Formats of splats have x to the right, y down, z forward; SPZ and glTF have y up.

use crate::Splat;

/// Axes whose reversal changes the sign of a spherical harmonic, in the order of spec 6.3 from degree 1: y, z, x; xy, yz, …
const ODD: [[bool; 3]; 15] = {
    const X: [bool; 3] = [true, false, false];
    const Y: [bool; 3] = [false, true, false];
    const Z: [bool; 3] = [false, false, true];
    const NONE: [bool; 3] = [false; 3];
    const XY: [bool; 3] = [true, true, false];
    const YZ: [bool; 3] = [false, true, true];
    const XZ: [bool; 3] = [true, false, true];
    const XYZ: [bool; 3] = [true; 3];
    [Y, Z, X, XY, YZ, NONE, XZ, NONE, Y, XYZ, Y, Z, X, Z, X]
};

/// Signs that convert x, y and z between other axes and those to the right, down and forward, in both directions.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Axes([f32; 3]);

impl Axes {
    /// Right, up, back: the default of SPZ.
    pub const RUB: Axes = Axes([1., -1., -1.]);

    /// Left, up, forward: the axes of splats in glTF, half a turn about z away.
    pub const LUF: Axes = Axes([-1., -1., 1.]);

    /// Returns the axes with this number in the extension SPZ_ADOBE_coordinate_system: 1 to 8 are LDB, RDB, LUB, RUB, LDF, RDF, LUF and
    /// RUF, 0 is unspecified. Returns `None` for other numbers.
    #[cfg(feature = "spz")]
    pub fn from_code(number: u32) -> Option<Self> {
        let sign = |positive: bool| if positive { 1. } else { -1. };
        match number {
            0 => Some(Axes::RUB),
            1..=8 => {
                let bits = number - 1;
                Some(Axes([sign(bits & 1 != 0), sign(bits & 2 == 0), sign(bits & 4 != 0)]))
            }
            _ => None,
        }
    }

    pub fn position(self, position: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|axis| self.0[axis] * position[axis])
    }

    /// Converts the rotation (w, x, y, z). Its direction about an axis is reversed if exactly one of the other two axes is reversed.
    pub fn rotation(self, [w, x, y, z]: [f32; 4]) -> [f32; 4] {
        let [of_x, of_y, of_z] = self.0;
        [w, of_y * of_z * x, of_x * of_z * y, of_x * of_y * z]
    }

    /// Returns the factors of the spherical harmonics of degree 1 and more.
    pub fn harmonics(self) -> [f32; 15] {
        ODD.map(|odd| odd.iter().zip(self.0).map(|(&odd, sign)| if odd { sign } else { 1. }).product())
    }

    /// Converts the Gaussians of `splat` exactly: numbers change their signs only.
    pub fn convert(self, splat: &mut Splat) {
        self.convert_without_rotations(splat);
        splat.quaternions.iter_mut().for_each(|quaternion| *quaternion = self.rotation(*quaternion));
    }

    /// Converts the Gaussians of `splat` like [`Axes::convert`], except for their rotations.
    pub fn convert_without_rotations(self, splat: &mut Splat) {
        let (bases, signs) = (splat.bases(), self.harmonics());
        splat.means.iter_mut().for_each(|mean| *mean = self.position(*mean));
        for of_one in splat.sh.chunks_exact_mut(bases) {
            for (color, sign) in of_one[1..].iter_mut().zip(signs) {
                *color = color.map(|channel| sign * channel);
            }
        }
    }
}
