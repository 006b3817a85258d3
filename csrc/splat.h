// The differentiable splat op on torch tensors. Rust calls it through cxx.
#pragma once

#include <cstddef>

#include "rust/cxx.h"

namespace globalsplat {

// Shared with Rust, see src/render.rs.
struct SplatArguments;
struct StageTimes;
struct PairCounts;
struct KernelTime;

// Renders Gaussians. Tensors may be on any device and of any floating type. Returns the addresses of three new tensors that the caller owns,
// on the device of the means, float64 if the means are and float32 otherwise: rgb [B, C, 3, H, W], accumulated opacity [B, C, H, W],
// expected depth [B, C, H, W]. Differentiable with respect to the five Gaussian tensors and w2c, whose entries are treated as independent.
// Throws (a Rust error) on shapes that don't fit.
rust::Vec<size_t> splat(const SplatArguments& of);

// Returns the wall-clock seconds of the stages of this thread's last call of splat() on the CPU, and of its backward pass.
StageTimes stage_times();

// Counts the pairs that splat() blends with these arguments, which must be float32 tensors on the CPU.
PairCounts count_pairs(const SplatArguments& of);

// Measures for `seconds` how many floating-point operations per second multiply-adds alone reach on libtorch's number of threads.
double multiply_add_peak(double seconds);

// Starts or ends the measurement of all launches of GPU kernels in this process, and discards previous results.
void measure_kernels(bool on);

// Returns the total time of every kernel launched since measurement began, in the order of first launches. Waits for the GPU.
rust::Vec<KernelTime> kernel_times();

// Returns the instruction set of the kernels in use. Throws if GLOBALSPLAT_SIMD names an unknown one.
rust::String simd_level();

}  // namespace globalsplat
