// The rasterizer's first step as an op of its own, so that it can be checked by itself.
#pragma once

#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

struct SplatArguments;  // shared with Rust, see src/render/bridge.rs

// Arguments as of splat(). `out` receives five new tensors: visible [B, C, N] (int64, 1 where a Gaussian isn't dropped),
// mean2d [B, C, N, 2], conic [B, C, N, 3] (xx, xy, yy of the inverse 2D covariance), depth [B, C, N] and colour
// [B, C, N, 3]; zeros where not visible. Differentiable with respect to means, scales, quaternions and sh.
void project(const SplatArguments& of, rust::Slice<size_t> out);

}  // namespace globalsplat
