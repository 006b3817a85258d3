// Tests of the GPU kernels in the emulation on a CPU.
#pragma once

#include <string>
#include <vector>

#include "scenes.h"

namespace globalsplat::checks {

// Renders `scene` with the kernels, forward and backward, with blocks and threads in the orders of these seeds, and with the CPU backend.
// Returns a description of the first difference; empty if images have the CPU's bits, gradients are close to the CPU's, and no order
// changes a bit.
std::string schedules_differ(const Scene<float>& scene, const std::vector<uint64_t>& seeds);

// Tests the prefix sums that sorting needs, with more counts than one block processes. Returns a description of the difference; empty if
// there is none.
std::string sums_differ(uint64_t seed);

// Tests the losses that compare images with photos, and their gradients. Returns a description of the first difference; empty if there is
// none.
std::string fits_differ(const std::vector<uint64_t>& seeds);

}  // namespace globalsplat::checks
