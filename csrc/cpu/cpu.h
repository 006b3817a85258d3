// CPU-only functions that Rust calls through cxx: measurements of the rasterizer, and its instruction set.
#pragma once

#include "rust/cxx.h"

namespace globalsplat {

// Shared with Rust, see src/render.rs.
struct SplatArguments;
struct StageTimes;
struct PairCounts;

// Returns the wall-clock seconds of the stages of this thread's last call of splat() on the CPU, and of its backward pass.
StageTimes stage_times();

// Counts the pairs that splat() has to blend with these arguments and float32 Gaussians.
PairCounts count_pairs(const SplatArguments& of);

// Measures for `seconds` how many floating-point operations per second multiply-adds alone reach on libtorch's number of threads.
double multiply_add_peak(double seconds);

// Returns the instruction set of the kernels in use. Throws if GLOBALSPLAT_SIMD names an unknown one.
rust::String simd_level();

}  // namespace globalsplat
