// The differentiable splat ops on torch tensors. Rust calls them through cxx.
#pragma once

#include <array>
#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

// Shared with Rust, see src/render.rs.
struct SplatArguments;
struct StageTimes;
struct PairCounts;
struct KernelTime;

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

// ---- measurements, and the CPU's instruction set ----

// Returns the wall-clock seconds of the stages of this thread's last call of splat() on the CPU, and of its backward pass.
StageTimes stage_times();

// Counts the pairs that splat() has to blend with these arguments and float32 Gaussians.
PairCounts count_pairs(const SplatArguments& of);

// Measures for `seconds` how many floating-point operations per second multiply-adds alone reach on libtorch's number of threads.
double multiply_add_peak(double seconds);

// Returns the instruction set of the kernels in use. Throws if GLOBALSPLAT_SIMD names an unknown one.
rust::String simd_level();

// Starts or ends the measurement of all launches in this process, and discards previous results.
void measure_kernels(bool on);

// Returns the total time of every kernel launched since measurement began, in the order of first launches. Waits for the GPU.
rust::Vec<KernelTime> kernel_times();

}  // namespace globalsplat
