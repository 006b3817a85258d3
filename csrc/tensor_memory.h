// Measurement of the memory that tensors take, for tests.
#pragma once

#include <cstdint>

namespace globalsplat {

// Begins counting the bytes that this thread allocates and frees for CPU tensors.
void start_counting_tensor_bytes();

// Ends counting and returns the peak.
uint64_t stop_counting_tensor_bytes();

}  // namespace globalsplat
