// The CPU's backend: raster/ on tensors' memory.
#pragma once

#include "../backend.h"

namespace globalsplat::cpu {

extern const Backend backend;

// splat.cpp
Pictures splat(const Inputs& in, std::unique_ptr<const Kept>& kept);
Gaussians splat_backward(const Inputs& in, const Pictures& drawn, const Pictures& gradients, const Kept& kept);

// projection.cpp
Projected project(const Inputs& in);
Gaussians project_backward(const Inputs& in, const Projected& gradients);

}  // namespace globalsplat::cpu
