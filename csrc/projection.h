// The rasterizer's first step as an op of its own, so that it can be checked by itself.
#pragma once

#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

// Arguments as of splat(). `out` receives five new tensors: visible [B, C, N] (int64, 1 where a Gaussian isn't dropped),
// mean2d [B, C, N, 2], conic [B, C, N, 3] (xx, xy, yy of the inverse 2D covariance), depth [B, C, N] and colour
// [B, C, N, 3]; zeros where not visible. Differentiable with respect to means, scales, quaternions and sh.
void project(size_t means, size_t scales, size_t quaternions, size_t opacities, size_t sh, size_t w2c,
             size_t intrinsics, int32_t width, int32_t height, double eps2d, rust::Slice<size_t> out);

}  // namespace globalsplat
