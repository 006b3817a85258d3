// Features and floating-point modes of the processor.
#pragma once

#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

enum class Bf16Support : uint8_t;

// Limit that GLOBALSPLAT_SIMD sets on the instruction sets of our own kernels and those of libtorch, oneDNN and MKL: `avx2` disables
// AVX-512 and bf16, `portable` disables AVX2 as well.
enum class SimdLimit { None, Avx2, Portable };
SimdLimit simd_limit();

// Returns the CPU's bf16 instructions that libtorch detects, or None if GLOBALSPLAT_SIMD disables them. Without such instructions, bf16
// products are slower than float32 products.
Bf16Support cpu_bf16_support();

// Returns true if the current GPU has bf16 instructions.
bool gpu_has_bf16();

// Returns the instruction set of libtorch's own kernels, such as "AVX2".
rust::String libtorch_simd_level();

// Makes this thread, and threads that it starts later, treat denormal numbers as 0. Does nothing on processors that don't support this.
void flush_denormals();

}  // namespace globalsplat
