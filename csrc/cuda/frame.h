// The rasterizer and the image losses on a GPU, as sequences of kernels in float32: the counterparts of raster::Frame and of
// ../kernels/jobs.h.
#pragma once

#include "../kernels/jobs.h"
#include "device.h"

namespace globalsplat::cuda {

// Inputs whose pointers are addresses in the device's memory.
using Arguments = raster::Arguments<float>;

// The Gaussians of every scene, projected into each of the scene's views.
struct ProjectedScenes {
  // Projects the Gaussians. Allocates and zeroes `tile_counts` if `counts_tiles`.
  ProjectedScenes(const Device&, const Arguments&, bool counts_tiles = false);

  // Computes the gradients of all Gaussians, and of w2c if `w2c` isn't null. The records of Gaussian i in a view are first[view·N + i] …
  // first[view·N + i + 1] − 1.
  void backward(const Device&, const Arguments&, const SplatGradient<float>* records, const uint32_t* first,
                const GaussianGradients<float>& out, float* w2c) const;

  Call call;
  Memory params;       // ProjectionParams[views]
  Memory splats;       // Splat[views][N]
  Memory tile_counts;  // uint32_t[views · tiles + 1], or null
};

// State of a forward pass that its backward pass needs.
class Frame {
 public:
  // Renders every view.
  Frame(const Device&, const Arguments&, const RenderOutput<float>& out);

  // Computes the gradients of the Gaussians, and of w2c if `w2c` isn't null, from the `gradients` of the images. `pictures` are the images
  // of the forward pass. The device and the arguments must be those of the forward pass.
  void backward(const Device&, const Arguments&, const RenderOutput<const float>& pictures,
                const RenderOutput<const float>& gradients, const GaussianGradients<float>& out, float* w2c) const;

 private:
  ProjectedScenes projected_;
  uint32_t count_;     // number of (splat, tile) pairs
  Memory first_;       // uint32_t[views · N + 1]: index of each splat's first record
  Memory entries_;     // TileEntry[count]: the lists of all tiles, consecutively
  Memory tile_start_;  // uint32_t[views · tiles + 1]: index of each list's first entry
};

// Partial sums on the device, whose total is a result.
struct PartialSums {
  Memory numbers;  // double[count]
  int64_t count;
};

// Compute raster::photometric() and raster::depth_smoothness(); addresses are in the device's memory.
PartialSums photometric(const Device&, const raster::LossJob<float>&, double l1_weight, double ssim_weight, float* gradient);
PartialSums depth_smoothness(const Device&, const raster::LossJob<float>&, double factor, float* gradient);

}  // namespace globalsplat::cuda
