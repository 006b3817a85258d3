// The differentiable splat ops on torch tensors. Rust calls them through cxx.
#pragma once

#include <array>
#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

struct SplatArguments;  // shared with Rust, see src/render.rs

// Renders Gaussians. Tensors may be on any device and of any floating type. `out` receives three new tensors that the caller owns, on the
// device of the means, float64 if the means are and float32 otherwise: rgb [B, C, 3, H, W], accumulated opacity [B, C, H, W], expected
// depth [B, C, H, W]. Differentiable with respect to the five Gaussian tensors and w2c, whose entries are treated as independent. Throws (a
// Rust error) on shapes that don't fit.
void splat(const SplatArguments& of, rust::Slice<size_t> out);

// Projects Gaussians: the rasterizer's first step as a separate op, so that it can be tested by itself. `out` receives five new tensors:
// visible [B, C, N] (int64, 1 if a Gaussian isn't dropped), mean2d [B, C, N, 2], conic [B, C, N, 3] (xx, xy, yy of the inverse 2D
// covariance), depth [B, C, N] and color [B, C, N, 3]; zeros for Gaussians that aren't visible. Differentiable with respect to means,
// scales, quaternions, sh and w2c.
void project(const SplatArguments& of, rust::Slice<size_t> out);

// Evaluates the first out.size() (1, 4, 9 or 16) spherical harmonics at a unit vector, as the rasterizer does.
void sh_basis(const std::array<double, 3>& direction, rust::Slice<double> out);

// Returns the version of the libtorch whose headers this was compiled with.
rust::String libtorch_version();

// Makes libtorch's errors carry no stack trace from now on. A stack trace allocates memory without handling failures, and it is captured
// and formatted for every error.
void disable_stack_traces();

}  // namespace globalsplat
