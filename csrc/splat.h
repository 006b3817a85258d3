// The differentiable splat op on torch tensors, and what Rust calls through cxx.
#pragma once

#include <array>
#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

// Tensors cross the border as pointers to at::Tensor (tch's C_tensor). The inputs are borrowed.
//   means [B, N, 3], scales [B, N, 3], quaternions [B, N, 4], opacities [B, N], sh [B, N, bases, 3]
//   w2c [B, C, 4, 4], intrinsics [B, C, 3, 3] in pixels
// float32 or float64 (all alike), on any device. `out` receives three new tensors that the caller owns, on the device
// of the means: rgb [B, C, 3, H, W], accumulated opacity [B, C, H, W], expected depth [B, C, H, W].
// Differentiable with respect to the five Gaussian tensors; cameras get no gradient.
// Throws (a Rust error) on shapes that don't fit.
void splat(size_t means, size_t scales, size_t quaternions, size_t opacities, size_t sh, size_t w2c,
           size_t intrinsics, int32_t width, int32_t height, double eps2d, rust::Slice<size_t> out);

struct StageTimes;  // shared with Rust, see src/render/bridge.rs

// Wall-clock seconds that the stages of this thread's last call of splat(), and of its backward pass, took.
StageTimes stage_times();

// The first out.size() (1, 4, 9 or 16) spherical harmonics of a unit vector, as the rasterizer evaluates them.
void sh_basis(const std::array<double, 3>& direction, rust::Slice<double> out);

// Of the libtorch whose headers this was compiled with.
rust::String libtorch_version();

// The instruction set of the kernels in use. Throws when GLOBALSPLAT_SIMD names an unknown one.
rust::String simd_level();

}  // namespace globalsplat
