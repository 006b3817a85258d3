// How much memory tensors take.
#pragma once

#include <cstdint>

namespace globalsplat {

// From now on this thread counts the bytes that its tensors on the CPU take, and give back.
void count_tensor_bytes();

// Ends that: the most that there were at a time beyond those of the beginning.
uint64_t most_tensor_bytes();

}  // namespace globalsplat
