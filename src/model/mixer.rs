//! The mixer, which exchanges information between the two streams once per round (spec 4.3).

use super::layers::{LayerScale, Mlp, layer_norm, normalize};
use super::precision::Precision;
use tch::{Tensor, nn};
use tracing::trace_span;

const MIXER_LAYER_SCALE: f64 = 1e-3;

/// MLP over the concatenated streams; each half of its output is added to one stream.
#[derive(Debug)]
pub(crate) struct Mixer {
    geometry_norm: nn::LayerNorm,
    appearance_norm: nn::LayerNorm,
    mlp: Mlp,
    geometry_scale: LayerScale,
    appearance_scale: LayerScale,
}

impl Mixer {
    pub fn new(vs: &nn::Path, d: i64) -> Self {
        Mixer {
            geometry_norm: layer_norm(vs / "ln_g", d),
            appearance_norm: layer_norm(vs / "ln_t", d),
            mlp: Mlp::new(vs / "mlp", 2 * d, d, 2 * d, ["0", "2"]),
            geometry_scale: LayerScale::new(vs / "ls_g", d, MIXER_LAYER_SCALE),
            appearance_scale: LayerScale::new(vs / "ls_t", d, MIXER_LAYER_SCALE),
        }
    }

    /// Returns the layers that compute in the configurable precision.
    pub fn linear_layers(&self) -> impl Iterator<Item = &nn::Linear> {
        self.mlp.linear_layers().into_iter()
    }

    /// Mixes the two streams, [B, S, d] each; the results have the same shape.
    pub fn forward(&self, geometry: &Tensor, appearance: &Tensor, precision: Precision) -> (Tensor, Tensor) {
        trace_span!("mixer").in_scope(|| {
            let both =
                [normalize(&self.geometry_norm, geometry), normalize(&self.appearance_norm, appearance)];
            let mixed = self.mlp.forward(&Tensor::cat(&both, -1), precision).chunk(2, -1);
            (self.geometry_scale.add(geometry, &mixed[0]), self.appearance_scale.add(appearance, &mixed[1]))
        })
    }
}
