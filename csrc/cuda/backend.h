// The GPU backend, and its emulation on a CPU.
#pragma once

#include "../backend.h"

namespace globalsplat::cuda {

// Backend for tensors on CUDA devices.
extern const Backend backend;

// Returns the backend that emulates a GPU for tensors on the CPU if the variable GLOBALSPLAT_CUDA_ON_CPU is set, and null otherwise. Its
// value is a number that seeds the order of blocks and threads.
const Backend* emulated_backend();

}  // namespace globalsplat::cuda
