// Validated arguments of the splat ops.
#pragma once

#include <ATen/core/Tensor.h>

#include "backend.h"

namespace globalsplat {

struct SplatArguments;  // shared with Rust, see src/render.rs

// Gaussians and cameras of one call, borrowed:
//   means [B, N, 3], scales [B, N, 3], quaternions [B, N, 4], opacities [B, N], sh [B, N, bases, 3]
//   w2c [B, C, 4, 4], intrinsics [B, C, 3, 3] in pixels
struct Arguments {
  const Tensor &means, &scales, &quaternions, &opacities, &sh, &w2c, &intrinsics;
  int64_t width, height;
  raster::ProjectionSettings projection;

  // Throws if shapes or values are invalid.
  void check() const;

  // Returns contiguous inputs on `device`, all of one type: float64 if the means are, and float32 otherwise. Moving and converting are
  // differentiable, so gradients return to the caller's device and type. Intrinsics get no gradient.
  Inputs to_inputs(at::Device device) const;
};

Arguments borrowed(const SplatArguments& of);

}  // namespace globalsplat
