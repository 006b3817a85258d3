// The backend of GPUs, and the same on a CPU in a GPU's place.
#pragma once

#include "../backend.h"

namespace globalsplat::cuda {

// Tensors of CUDA devices.
extern const Backend backend;

// Tensors of the CPU, where the variable GLOBALSPLAT_CUDA_ON_CPU is set: to a number, from which the order of blocks and threads is
// drawn. Null where it isn't.
const Backend* emulated_backend();

}  // namespace globalsplat::cuda
