// How much memory tensors take: what tests measure.
#pragma once

#include <cstdint>

namespace globalsplat {

// Begins counting the bytes that this thread's tensors on the CPU take and give back.
void count_tensor_bytes();

// Ends that, and returns the peak.
uint64_t most_tensor_bytes();

}  // namespace globalsplat
