//! A backward pass in several parts: the forward pass is cut at detached tensors that collect the gradients.

use tch::{Kind, Tensor};

/// Returns a detached copy of `output` that requires a gradient: the input of the next part, where that part's backward pass ends.
pub(crate) fn leaf(output: &Tensor) -> Tensor {
    output.detach().set_requires_grad(true)
}

/// Returns `true` if gradients will flow back to `t` from what is computed from it now. `t.requires_grad()` is not enough: a leaf, and a
/// view of one, report their own flag even where gradients are disabled.
pub(crate) fn tracks_grad(t: &Tensor) -> bool {
    t.sum(Kind::Float).requires_grad()
}

/// Continues the backward pass from the `outputs` of a part, each paired with the detached copy that holds its gradient.
///
/// tch can't start a backward pass with given gradients. The sum of the products of outputs and gradients has exactly these gradients.
pub(crate) fn backward_from_grads(outputs: &[(&Tensor, &Tensor)]) {
    let products = outputs.iter().filter_map(|(output, leaf)| {
        let gradient = leaf.grad();
        gradient.defined().then(|| (*output * gradient).sum(Kind::Float))
    });
    if let Some(objective) = products.reduce(|a, b| a + b) {
        objective.backward();
    }
}
