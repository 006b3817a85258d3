// Measurement of the memory that tensors take, for tests.
#pragma once

#include <cstdint>

namespace globalsplat {

// Begins counting the bytes that this thread allocates and frees for CPU tensors.
void count_tensor_bytes();

// Ends counting and returns the peak.
uint64_t most_tensor_bytes();

}  // namespace globalsplat
