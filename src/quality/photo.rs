//! Sharpness and exposure of a photo.

use crate::data::View;
use serde::Serialize;
use tch::{Kind, Tensor, no_grad};

/// Reduction of the image whose edges the photo's own are compared with.
const REDUCTION: i64 = 4;
/// Fraction of the pixels that count as edges: those with the steepest gradients.
const EDGES: f64 = 0.005;
/// Gray values at or beyond which a pixel shows nothing, as it is too dark or too bright.
const CLIPPED: (f64, f64) = (2. / 255., 253. / 255.);

/// Sharpness below which a photo is blurred.
const MIN_SHARPNESS: f64 = 0.45;
/// Fraction of a photo's pairs that contradict its pose, from which on it is doubtful.
const DOUBTFUL_POSE: f64 = 0.5;
/// Fraction of the pixels that may be black or white.
const MAX_CLIPPED: f64 = 0.3;

/// Quality of a photo.
#[derive(Debug, Clone, Serialize)]
pub struct PhotoQuality {
    /// Name of the photo in the capture.
    pub name: String,
    /// Steepness of the edges relative to that of the photo at a quarter of its size: 1 for a sharp photo, 0.3 for edges that a Gaussian of
    /// two pixels blurs.
    pub sharpness: f64,
    /// Fraction of the pixels that are black.
    pub too_dark: f64,
    /// Fraction of the pixels that are white.
    pub too_bright: f64,
    /// Fraction of the pairs with this photo in which photos don't look alike where they should; `None` if there is no pair.
    pub contradicting: Option<f64>,
}

impl PhotoQuality {
    /// Measures a photo at its size, over the pixels that count. Pairs with other photos are unknown.
    pub fn measure(view: &View) -> Self {
        no_grad(|| {
            let gray = view.image.to_float().mean_dim([0i64].as_slice(), true, Kind::Float);
            let counted = view.mask_or_ones().to_float().ge(0.5).to_kind(Kind::Float);
            let all = counted.sum(Kind::Double).double_value(&[]).max(1.);
            let share = |mask: Tensor| {
                (mask.to_kind(Kind::Float) * &counted).sum(Kind::Double).double_value(&[]) / all
            };
            let reduce = |image: &Tensor| {
                image.unsqueeze(0).avg_pool2d(REDUCTION, REDUCTION, 0, false, true, None).squeeze_dim(0)
            };
            let edges = edge_gradient(&gray, &counted);
            let reduced = edge_gradient(&reduce(&gray), &reduce(&counted));
            let (dark, bright) = CLIPPED;
            PhotoQuality {
                name: view.name.clone(),
                sharpness: edges / reduced.max(1e-6),
                too_dark: share(gray.le(dark)),
                too_bright: share(gray.ge(bright)),
                contradicting: None,
            }
        })
    }

    /// Returns `true` if the photo is blurred.
    pub fn is_blurred(&self) -> bool {
        self.sharpness < MIN_SHARPNESS
    }

    /// Returns `true` if most photos don't look as this one's pose and depths predict.
    pub fn has_doubtful_pose(&self) -> bool {
        self.contradicting.is_some_and(|share| share > DOUBTFUL_POSE)
    }

    /// Returns `true` if much of the photo is black or white.
    pub fn is_clipped(&self) -> bool {
        self.too_dark + self.too_bright > MAX_CLIPPED
    }
}

/// Returns the gradient in gray values per pixel that the steepest edges of an image [1, H, W] have, between pixels that count as a whole:
/// where `counted` [1, H, W] is 1.
fn edge_gradient(gray: &Tensor, counted: &Tensor) -> f64 {
    let [_, height, width] = gray.size()[..] else { unreachable!("an image") };
    let corner = |image: &Tensor, dim: i64, first: i64| {
        let [rows, columns] = if dim == 1 { [first, 0] } else { [0, first] };
        image.narrow(1, rows, height - 1).narrow(2, columns, width - 1)
    };
    let difference = |dim: i64| corner(gray, dim, 1) - corner(gray, dim, 0);
    let is_counted = [corner(counted, 1, 0), corner(counted, 1, 1), corner(counted, 2, 1)]
        .into_iter()
        .reduce(|a, b| a.minimum(&b))
        .expect("three corners")
        .ge(1.);
    let squares = (difference(1).square() + difference(2).square()).masked_select(&is_counted);
    let count = (squares.numel() as f64 * EDGES).ceil() as i64;
    if count == 0 {
        return 0.;
    }
    let (steepest, _) = squares.topk(count, 0, true, false);
    steepest.mean(Kind::Double).sqrt().double_value(&[])
}
