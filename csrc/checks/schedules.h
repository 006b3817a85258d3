// The kernels for GPUs, run on a CPU in a GPU's place.
#pragma once

#include <string>
#include <vector>

#include "scenes.h"

namespace globalsplat::checks {

// What differs when the kernels render `scene`, forward and backward, with blocks and threads in the orders of these seeds, or when
// the CPU's backend does; empty if pictures have the CPU's bits, gradients are near to its, and no order changes a bit.
std::string schedules_differ(const Scene<float>& scene, const std::vector<uint64_t>& seeds);

// The same of the sums that sorting needs, of more counts than a block takes in one go.
std::string sums_differ(uint64_t seed);

// The same of how far pictures are from photos, with their gradients.
std::string fits_differ(const std::vector<uint64_t>& seeds);

}  // namespace globalsplat::checks
