// Whether there are instructions for bf16: without them its products are slower than those of float32.
#pragma once

#include <cstdint>

namespace globalsplat {

enum class Bf16 : uint8_t;

// Of the CPU, as libtorch sees it.
Bf16 bf16_of_cpu();

// Of the current GPU.
bool gpu_has_bf16();

}  // namespace globalsplat
