// Losses of rendered images and depths compared to photos, on torch tensors. Rust calls them through cxx.
#pragma once

#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

// Computes `l1_weight` · mean |picture − photo| + `ssim_weight` · mean SSIM (spec 9.4) of two tensors [.., H, W] of one shape, both sides
// at least 11. Arguments are addresses of live tensors. `out` receives a new scalar tensor that the caller owns, on the device of
// `picture`, float64 if `picture` is and float32 otherwise. Differentiable with respect to `picture`. Throws on shapes that don't fit.
void photometric(size_t picture, size_t photo, double l1_weight, double ssim_weight, rust::Slice<size_t> out);

// Computes `factor` · the edge-aware smoothness of depths (kernels/smoothness.h), for depths [.., H, W] and photos [.., 3, H, W]. Devices,
// types and ownership are as in photometric(). Differentiable with respect to the depths.
void depth_smoothness(size_t depths, size_t photos, double factor, rust::Slice<size_t> out);

}  // namespace globalsplat
