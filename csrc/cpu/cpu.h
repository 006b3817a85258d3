// What only a CPU has, as Rust calls it through cxx: measurements of the rasterizer, and its instruction set.
#pragma once

#include "rust/cxx.h"

namespace globalsplat {

// Shared with Rust, see src/render.rs.
struct SplatArguments;
struct StageTimes;
struct PairCounts;

// Wall-clock seconds that the stages of this thread's last call of splat() on the CPU, and of its backward pass, took.
StageTimes stage_times();

// What a call of splat() with float32 Gaussians has to blend. Same arguments.
PairCounts count_pairs(const SplatArguments& of);

// Floating-point operations per second that multiply-adds alone reach on libtorch's number of threads, in `seconds`.
double multiply_add_peak(double seconds);

// The instruction set of the kernels in use. Throws when GLOBALSPLAT_SIMD names an unknown one.
rust::String simd_level();

}  // namespace globalsplat
