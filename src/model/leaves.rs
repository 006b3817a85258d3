//! The backward pass by hand: a forward pass in parts, with leaves between them that collect the gradients.

use tch::{Kind, Tensor};

/// The same values with no way back: what the part before handed on, where the next one's backward pass ends.
pub(crate) fn leaf(output: &Tensor) -> Tensor {
    output.detach().set_requires_grad(true)
}

/// Whether gradients will come back to `t` from what is computed of it now. A leaf, and a view of one, would say what it asks for
/// even where gradients are off.
pub(crate) fn is_followed(t: &Tensor) -> bool {
    t.sum(Kind::Float).requires_grad()
}

/// Goes on with the backward pass from `outputs` of a part, whose gradients are those of the leaves beside them.
///
/// tch can't begin with given gradients; with the sum of products it begins with just these.
pub(crate) fn pull_back(outputs: &[(&Tensor, &Tensor)]) {
    let products = outputs.iter().filter_map(|(output, leaf)| {
        let gradient = leaf.grad();
        gradient.defined().then(|| (*output * gradient).sum(Kind::Float))
    });
    if let Some(objective) = products.reduce(|a, b| a + b) {
        objective.backward();
    }
}
