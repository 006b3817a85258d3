// The rasterizer on a device: what raster::Frame is on the CPU, in float32, kernel after kernel.
#pragma once

#include "device.h"

namespace globalsplat::cuda {

// Addresses of a device's memory: the op's tensors, one after the other.
struct Arguments {
  Gaussians<float> gaussians;  // of all scenes; `count` is that of one
  const float* w2c;            // [B, C, 4, 4]
  const float* intrinsics;     // [B, C, 3, 3]
  int64_t scenes, cameras;
  int width, height;
  double eps2d;
};

// All Gaussians as every view sees them.
struct Seen {
  // `counts_tiles`: whether there is to be memory for counts of tiles.
  Seen(const Device&, const Arguments&, bool counts_tiles = false);

  // Writes every gradient of every Gaussian, and of w2c where it isn't null, from the records first[view·N + i] …
  // first[view·N + i + 1] − 1 of every Gaussian i in every view.
  void backward(const Device&, const Arguments&, const SplatGradient<float>* records, const uint32_t* first,
                const GaussianGradients<float>& out, float* w2c) const;

  Call call;
  Memory lenses;  // Lens[views]
  Memory splats;  // Splat[views][N]
  Memory tile_counts;  // uint32_t[views · tiles + 1], all 0
};

// What a forward pass leaves for its backward pass.
class Frame {
 public:
  // Draws every view.
  Frame(const Device&, const Arguments&, const Pictures<float>& out);

  // Everything but `out` and `w2c`, as in Seen::backward(), is as in the forward pass.
  void backward(const Device&, const Arguments&, const Pictures<const float>& pictures,
                const Pictures<const float>& gradients, const GaussianGradients<float>& out, float* w2c) const;

 private:
  Seen seen_;
  uint32_t count_;     // of (splat, tile) pairs
  Memory first_;       // uint32_t[views · N + 1]: where each splat's records begin
  Memory entries_;     // TileEntry[count]: all tiles' lists, one after the other
  Memory tile_start_;  // uint32_t[views · tiles + 1]
};

}  // namespace globalsplat::cuda
