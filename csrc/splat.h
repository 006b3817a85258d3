// The differentiable splat op on torch tensors, and what Rust calls through cxx.
#pragma once

#include <array>
#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

// Shared with Rust, see src/render/bridge.rs.
struct SplatArguments;
struct StageTimes;
struct PairCounts;

// Tensors of float32 or float64 (all alike), on any device. `out` receives three new tensors that the caller owns, on the device
// of the means: rgb [B, C, 3, H, W], accumulated opacity [B, C, H, W], expected depth [B, C, H, W].
// Differentiable with respect to the five Gaussian tensors; cameras get no gradient.
// Throws (a Rust error) on shapes that don't fit.
void splat(const SplatArguments& of, rust::Slice<size_t> out);


// Wall-clock seconds that the stages of this thread's last call of splat(), and of its backward pass, took.
StageTimes stage_times();

// What a call of splat() with float32 Gaussians has to blend. Same arguments.
PairCounts count_pairs(const SplatArguments& of);

// Floating-point operations per second that multiply-adds alone reach on libtorch's number of threads, in `seconds`.
double multiply_add_peak(double seconds);

// The first out.size() (1, 4, 9 or 16) spherical harmonics of a unit vector, as the rasterizer evaluates them.
void sh_basis(const std::array<double, 3>& direction, rust::Slice<double> out);

// Of the libtorch whose headers this was compiled with.
rust::String libtorch_version();

// The instruction set of the kernels in use. Throws when GLOBALSPLAT_SIMD names an unknown one.
rust::String simd_level();

}  // namespace globalsplat
