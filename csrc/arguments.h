// What the splat ops are called with from Rust, checked.
#pragma once

#include <ATen/core/Tensor.h>

#include "backend.h"

namespace globalsplat {

struct SplatArguments;  // shared with Rust, see src/render.rs

// Gaussians and cameras of one call, borrowed.
//   means [B, N, 3], scales [B, N, 3], quaternions [B, N, 4], opacities [B, N], sh [B, N, bases, 3]
//   w2c [B, C, 4, 4], intrinsics [B, C, 3, 3] in pixels
struct Arguments {
  const Tensor &means, &scales, &quaternions, &opacities, &sh, &w2c, &intrinsics;
  int64_t width, height;
  double eps2d;

  // Throws on shapes and numbers that don't fit.
  void check() const;

  // On `device`, contiguous, of one type: float64 where the means are, float32 else. Moving and converting are differentiable,
  // so gradients go back to the caller's device and type. Intrinsics get none.
  Inputs on(at::Device device) const;
};

Arguments borrowed(const SplatArguments& of);

}  // namespace globalsplat
