// The CPU backend: it runs the rasterizer of kernels/ on tensors' memory.
#pragma once

#include "../backend.h"

namespace globalsplat::cpu {

extern const Backend backend;

// splat.cpp
RenderOutput splat(const Inputs& in, std::unique_ptr<const SavedState>& saved);
Gradients splat_backward(const Inputs& in, const RenderOutput& outputs, const RenderOutput& gradients, const SavedState& saved, GradientRequest request);

// projection.cpp
Projected project(const Inputs& in);
Gradients project_backward(const Inputs& in, const Projected& gradients, GradientRequest request);

}  // namespace globalsplat::cpu
