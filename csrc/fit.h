// Losses and optimizer steps that fit rendered images to photos, on torch tensors. Rust calls them through cxx.
#pragma once

#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

struct AdamArguments;  // shared with Rust, see src/fit.rs

// Computes `l1_weight` · mean |picture − photo| + `ssim_weight` · mean SSIM (spec 9.4) of two tensors [.., H, W] of one shape, both sides
// at least 11. Arguments are addresses of live tensors. `out` receives a new scalar tensor that the caller owns, on the device of
// `picture`, float64 if `picture` is and float32 otherwise. Differentiable with respect to `picture`. Throws on shapes that don't fit.
void photometric(size_t picture, size_t photo, double l1_weight, double ssim_weight, rust::Slice<size_t> out);

// Computes `factor` · the edge-aware smoothness of depths (kernels/smooth.h), for depths [.., H, W] and photos [.., 3, H, W]. Devices,
// types and ownership are as in photometric(). Differentiable with respect to the depths.
void depth_smoothness(size_t depths, size_t photos, double factor, rust::Slice<size_t> out);

// Updates a tensor and its moments in place, hidden from autograd. All four tensors must be contiguous, on the CPU, of one shape and type,
// float32 or float64; throws otherwise.
void adam(const AdamArguments& of);

}  // namespace globalsplat
