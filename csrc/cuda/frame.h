// The rasterizer on a GPU: the counterpart of raster::Frame, in float32, as a sequence of kernels.
#pragma once

#include "device.h"

namespace globalsplat::cuda {

// Addresses in a device's memory: the op's tensors, each for all scenes and views.
struct Arguments {
  Gaussians<float> gaussians;  // of all scenes; `count` is per scene
  const float* w2c;            // [B, C, 4, 4]
  const float* intrinsics;     // [B, C, 3, 3]
  int64_t scenes, cameras;
  int width, height;
  double eps2d;
};

// All Gaussians projected into every view.
struct ProjectedScenes {
  // Projects the Gaussians. `counts_tiles` requests memory for counts of tiles.
  ProjectedScenes(const Device&, const Arguments&, bool counts_tiles = false);

  // Computes every gradient of every Gaussian, and of w2c if it isn't null. The records of Gaussian i in a view are first[view·N + i] …
  // first[view·N + i + 1] − 1.
  void backward(const Device&, const Arguments&, const SplatGradient<float>* records, const uint32_t* first,
                const GaussianGradients<float>& out, float* w2c) const;

  Call call;
  Memory lenses;  // Lens[views]
  Memory splats;  // Splat[views][N]
  Memory tile_counts;  // uint32_t[views · tiles + 1], zeroed
};

// State of a forward pass for its backward pass.
class Frame {
 public:
  // Renders every view.
  Frame(const Device&, const Arguments&, const RenderOutput<float>& out);

  // Computes gradients as ProjectedScenes::backward() does. All arguments except `gradients`, `out` and `w2c` must be those of the forward pass.
  void backward(const Device&, const Arguments&, const RenderOutput<const float>& pictures,
                const RenderOutput<const float>& gradients, const GaussianGradients<float>& out, float* w2c) const;

 private:
  ProjectedScenes projected_;
  uint32_t count_;     // number of (splat, tile) pairs
  Memory first_;       // uint32_t[views · N + 1]: index of each splat's first record
  Memory entries_;     // TileEntry[count]: all tiles' lists, one after the other
  Memory tile_start_;  // uint32_t[views · tiles + 1]
};

}  // namespace globalsplat::cuda
