// Features and floating-point modes of the processor.
#pragma once

#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

enum class Bf16Support : uint8_t;

// Instruction sets that GLOBALSPLAT_SIMD allows, for our own kernels and for those of libtorch, oneDNN and MKL: `avx2` hides AVX-512 and
// bf16, `portable` hides AVX2 as well.
enum class SimdLimit { None, Avx2, Portable };
SimdLimit simd_limit();

// Returns the CPU's bf16 instructions, as libtorch sees them; without any, bf16 products are slower than float32 products. None if
// GLOBALSPLAT_SIMD hides them.
Bf16Support bf16_of_cpu();

// Returns true if the current GPU has bf16 instructions.
bool gpu_has_bf16();

// Returns the instruction set of libtorch's own kernels, such as "AVX2".
rust::String libtorch_simd_level();

// Makes this thread, and threads that it starts from now on, treat denormal numbers as 0. A no-op on processors that don't support it.
void flush_denormals();

}  // namespace globalsplat
