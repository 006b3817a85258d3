// What the processor has, and how it computes.
#pragma once

#include <cstdint>

namespace globalsplat {

enum class Bf16 : uint8_t;

// Whether there are instructions for bf16, as libtorch sees it: without them its products are slower than those of float32.
Bf16 bf16_of_cpu();

// The same of the current GPU.
bool gpu_has_bf16();

// Has this thread, and those that it starts from now on, take numbers for 0 that are too small to have all their digits. Where the
// processor can't, they stay.
void flush_denormals();

}  // namespace globalsplat
