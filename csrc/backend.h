// What a kind of device gives to serve the splat ops by itself. splat.cpp does for all of them what is the same: it checks the
// arguments, moves them, and lets autograd remember.
#pragma once

#include <ATen/core/Tensor.h>

#include <memory>

namespace globalsplat {

using at::Tensor;

// The Gaussians of all scenes, or their gradients; shapes as in arguments.h.
struct Gaussians {
  Tensor means, scales, quaternions, opacities, sh;
};

// What an op reads: on the backend's device, contiguous, all float32 or all float64; shapes as in arguments.h.
struct Inputs {
  Gaussians gaussians;
  Tensor w2c, intrinsics;
  int64_t width, height;  // pixels
  double eps2d;           // pixels²

  int64_t scenes() const { return w2c.size(0); }
  int64_t cameras() const { return w2c.size(1); }  // of a scene
  int64_t count() const { return gaussians.means.size(1); }  // Gaussians of a scene
};

// What a backward pass gives.
struct Gradients {
  Gaussians gaussians;
  Tensor w2c;  // [B, C, 4, 4], the last rows 0; undefined where nobody asked
};

// What splat() draws, or its gradients: [B, C, 3, H, W], [B, C, H, W], [B, C, H, W].
struct Pictures {
  Tensor rgb, alpha, depth;
};

// What project() makes, or its gradients, of which that of `visible` isn't there; shapes as in splat.h.
struct Projected {
  Tensor visible, mean2d, conic, depth, colour;
};

// What a backend's splat() leaves for its splat_backward(), beside tensors.
struct Kept {
  virtual ~Kept() = default;
};

// New tensors have the device and the type of the inputs. Gradients come in contiguous, and go out for all five Gaussian tensors,
// and for w2c `of_cameras`.
struct Backend {
  at::DeviceType device;
  Pictures (*splat)(const Inputs&, std::unique_ptr<const Kept>& kept);
  Gradients (*splat_backward)(const Inputs&, const Pictures& drawn, const Pictures& gradients, const Kept&, bool of_cameras);
  Projected (*project)(const Inputs&);
  Gradients (*project_backward)(const Inputs&, const Projected& gradients, bool of_cameras);
};

}  // namespace globalsplat
