//! The model's result.

use tch::{Device, Tensor};

/// 3D Gaussians of B scenes with N each.
#[derive(Debug)]
pub struct Gaussians {
    /// Centres, [B, N, 3].
    pub means: Tensor,
    /// Standard deviations along the own axes, linear, [B, N, 3].
    pub scales: Tensor,
    /// (w, x, y, z), [B, N, 4].
    pub quaternions: Tensor,
    /// In [0, 1], [B, N].
    pub opacities: Tensor,
    /// Spherical harmonics, [B, N, (degree + 1)², 3].
    pub sh: Tensor,
}

impl Gaussians {
    /// N.
    pub fn count(&self) -> i64 {
        self.means.size()[1]
    }

    /// Applies `f` to every tensor.
    pub fn map(&self, f: impl Fn(&Tensor) -> Tensor) -> Self {
        Gaussians {
            means: f(&self.means),
            scales: f(&self.scales),
            quaternions: f(&self.quaternions),
            opacities: f(&self.opacities),
            sh: f(&self.sh),
        }
    }

    /// A copy on `device`, or the same tensors where they are there already.
    pub fn to_device(&self, device: Device) -> Self {
        self.map(|t| t.to_device(device))
    }
}
