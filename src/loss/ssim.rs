//! Structural similarity (Wang et al. 2004), as scikit-image's `structural_similarity` with Gaussian weights computes it.
//! (Spec 9.4.)

use tch::{Kind, Tensor};

/// The Gaussian window: 11×11, σ = 1.5.
const WINDOW: i64 = 11;
const SIGMA: f64 = 1.5;
/// (0.01 L)² and (0.03 L)² for the data range L = 1.
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// The mean over pictures, channels and the pixels whose window is inside, with sample covariances; 1 for equal pictures. A
/// differentiable scalar. Pictures [.., H, W] in [0, 1] of one shape, H and W at least 11.
pub fn ssim(picture: &Tensor, truth: &Tensor) -> Tensor {
    let planes = |t: &Tensor| {
        let size = t.size();
        t.reshape([-1, 1, size[size.len() - 2], size[size.len() - 1]])
    };
    let (x, y) = (planes(picture), planes(truth));
    let offsets = Tensor::arange(WINDOW, (Kind::Double, x.device())) - ((WINDOW - 1) / 2) as f64;
    let weights = (offsets.square() / (-2. * SIGMA * SIGMA)).exp();
    let weights = (&weights / weights.sum(Kind::Double)).to_kind(x.kind());
    let blur = |t: &Tensor| {
        let column = weights.view([1, 1, WINDOW, 1]);
        let row = weights.view([1, 1, 1, WINDOW]);
        t.conv2d(&column, None::<&Tensor>, 1, 0, 1, 1).conv2d(&row, None::<&Tensor>, 1, 0, 1, 1)
    };
    let pixels = (WINDOW * WINDOW) as f64;
    let sample = pixels / (pixels - 1.);
    let (mx, my) = (blur(&x), blur(&y));
    let vx = (blur(&x.square()) - mx.square()) * sample;
    let vy = (blur(&y.square()) - my.square()) * sample;
    let vxy = (blur(&(&x * &y)) - &mx * &my) * sample;
    let numerator = (&mx * &my * 2. + C1) * (vxy * 2. + C2);
    let denominator = (mx.square() + my.square() + C1) * (vx + vy + C2);
    (numerator / denominator).mean(None::<Kind>)
}
