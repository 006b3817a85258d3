// The differentiable splat ops on torch tensors, as Rust calls them through cxx.
#pragma once

#include <array>
#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

struct SplatArguments;  // shared with Rust, see src/render.rs

// Tensors of any device and floating type. `out` receives three new tensors that the caller owns, on the device of the means,
// float64 where the means are and float32 else: rgb [B, C, 3, H, W], accumulated opacity [B, C, H, W], expected depth
// [B, C, H, W]. Differentiable with respect to the five Gaussian tensors and w2c, whose entries are taken as free numbers.
// Throws (a Rust error) on shapes that don't fit.
void splat(const SplatArguments& of, rust::Slice<size_t> out);

// The rasterizer's first step as an op of its own, so that it can be checked by itself. `out` receives five new tensors:
// visible [B, C, N] (int64, 1 where a Gaussian isn't dropped), mean2d [B, C, N, 2], conic [B, C, N, 3] (xx, xy, yy of the
// inverse 2D covariance), depth [B, C, N] and colour [B, C, N, 3]; zeros where not visible. Differentiable with respect to
// means, scales, quaternions, sh and w2c.
void project(const SplatArguments& of, rust::Slice<size_t> out);

// The first out.size() (1, 4, 9 or 16) spherical harmonics of a unit vector, as the rasterizer evaluates them.
void sh_basis(const std::array<double, 3>& direction, rust::Slice<double> out);

// Of the libtorch whose headers this was compiled with.
rust::String libtorch_version();

// Has libtorch's errors, from now on, carry no stack trace. It takes memory without asking whether there is any, and is taken
// and put in words for every error.
void leave_out_stack_traces();

}  // namespace globalsplat
