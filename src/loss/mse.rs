//! The rendering loss's first half: ‖I − Î‖² per element.

use tch::{Kind, Tensor};

/// Mean over all elements; a scalar.
pub fn mse(rendered: &Tensor, truth: &Tensor) -> Tensor {
    (rendered - truth).square().mean(None::<Kind>)
}
