// Access of the rasterizer to CPU tensors as plain memory.
#pragma once

#include <ATen/ops/empty_like.h>
#include <ATen/ops/zeros_like.h>

#include <vector>

#include "../backend.h"
#include "../kernels/projection_params.h"
#include "../kernels/raster.h"

namespace globalsplat::cpu {

// Calls body(0.) or body(0.f), depending on the type of the inputs.
template <class Body>
auto dispatch_by_type(const Inputs& in, Body body) {
  return in.gaussians.means.scalar_type() == at::kDouble ? body(0.) : body(0.f);
}

// Returns the Gaussians, one item per scene.
template <class T>
std::vector<raster::Gaussians<T>> scenes_of(const Inputs& in) {
  std::vector<raster::Gaussians<T>> scenes;
  const Gaussians& g = in.gaussians;
  const int64_t count = in.count(), bases = g.sh.size(2);
  for (int64_t b = 0; b < in.scenes(); ++b)
    scenes.push_back({g.means.data_ptr<T>() + b * count * 3, g.scales.data_ptr<T>() + b * count * 3,
                      g.quaternions.data_ptr<T>() + b * count * 4, g.opacities.data_ptr<T>() + b * count,
                      g.sh.data_ptr<T>() + b * count * bases * 3, count, int(bases)});
  return scenes;
}

// Returns the gradients of Gaussians, one item per scene.
template <class T>
std::vector<raster::GaussianGradients<T>> gradients_of(const Gradients& of) {
  std::vector<raster::GaussianGradients<T>> scenes;
  const Gaussians& g = of.gaussians;
  const int64_t count = g.means.size(1), bases = g.sh.size(2);
  for (int64_t b = 0; b < g.means.size(0); ++b)
    scenes.push_back({g.means.data_ptr<T>() + b * count * 3, g.scales.data_ptr<T>() + b * count * 3,
                      g.quaternions.data_ptr<T>() + b * count * 4, g.opacities.data_ptr<T>() + b * count,
                      g.sh.data_ptr<T>() + b * count * bases * 3,
                      of.means2d.defined() ? of.means2d.data_ptr<T>() + b * of.means2d[0].numel() : nullptr});
  return scenes;
}

// Returns the views, one item per camera of each scene.
template <class T>
std::vector<raster::View<T>> views_of(const Inputs& in) {
  std::vector<raster::View<T>> views;
  for (int64_t b = 0; b < in.scenes(); ++b)
    for (int64_t c = 0; c < in.cameras(); ++c) {
      const int64_t view = b * in.cameras() + c;
      views.push_back({raster::camera_of(in.w2c.data_ptr<T>() + view * 16, in.intrinsics.data_ptr<T>() + view * 9), int(b)});
    }
  return views;
}

// Converts the gradients of views to the gradient of the op's w2c.
template <class T>
Tensor w2c_gradient(const Inputs& in, const std::vector<raster::CameraGradient<T>>& of_views) {
  const Tensor out = at::zeros_like(in.w2c);
  for (size_t k = 0; k < of_views.size(); ++k) {
    T* m = out.data_ptr<T>() + k * 16;
    for (int row = 0; row < 3; ++row) {
      for (int column = 0; column < 3; ++column) m[4 * row + column] = of_views[k].numbers[3 * row + column];
      m[4 * row + 3] = of_views[k].numbers[9 + row];
    }
  }
  return out;
}

// Returns uninitialized tensors of the same shapes.
inline Gaussians empty_like(const Gaussians& g) {
  const auto empty = [](const Tensor& t) { return at::empty_like(t); };
  return {empty(g.means), empty(g.scales), empty(g.quaternions), empty(g.opacities), empty(g.sh)};
}

}  // namespace globalsplat::cpu
