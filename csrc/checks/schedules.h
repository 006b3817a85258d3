// Tests of the GPU kernels in the emulation on a CPU.
#pragma once

#include <string>
#include <vector>

#include "scenes.h"

namespace globalsplat::checks {

// Renders `scene`, forward and backward, with the CPU backend and with the kernels, once per seed; a seed determines the order of blocks
// and threads. Images must have the CPU's bits, gradients must be close to the CPU's, and all orders must give the same bits. Returns a
// description of the first difference, empty if there is none.
std::string schedules_differ(const Scene<float>& scene, const std::vector<uint64_t>& seeds);

// Tests the prefix sums that sorting needs, with more counts than one block processes. Returns a description of the difference; empty if
// there is none.
std::string sums_differ(uint64_t seed);

// Tests the losses that compare images with photos, and their gradients. Returns a description of the first difference; empty if there is
// none.
std::string losses_differ(const std::vector<uint64_t>& seeds);

}  // namespace globalsplat::checks
