// What the processor has, and how it computes.
#pragma once

#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

enum class Bf16 : uint8_t;

// What GLOBALSPLAT_SIMD limits instructions to, those of our kernels and, as if the processor had no others, those of libtorch, oneDNN
// and MKL: `avx2` hides AVX-512 and bf16, `portable` AVX2 as well.
enum class SimdLimit { None, Avx2, Portable };
SimdLimit simd_limit();

// Whether there are instructions for bf16, as libtorch sees it: without them its products are slower than those of float32. None where
// GLOBALSPLAT_SIMD hides them.
Bf16 bf16_of_cpu();

// The same of the current GPU.
bool gpu_has_bf16();

// The instruction set of libtorch's own kernels, such as "AVX2".
rust::String libtorch_simd_level();

// Has this thread, and those that it starts from now on, take numbers for 0 that are too small to have all their digits. Where the
// processor can't, they stay.
void flush_denormals();

}  // namespace globalsplat
