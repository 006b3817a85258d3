// Tensors that cross the border from Rust, checked and laid out for the rasterizer.
#pragma once

#include <torch/torch.h>

#include <vector>

#include "raster/raster.h"
#include "rust/cxx.h"

namespace globalsplat {

struct SplatArguments;  // shared with Rust, see src/render/bridge.rs

using torch::Tensor;
using torch::autograd::tensor_list;

constexpr size_t kGaussianInputs = 5;  // means, scales, quaternions, opacities, sh

// Gaussians and cameras of one call, borrowed.
//   means [B, N, 3], scales [B, N, 3], quaternions [B, N, 4], opacities [B, N], sh [B, N, bases, 3]
//   w2c [B, C, 4, 4], intrinsics [B, C, 3, 3] in pixels
struct Arguments {
  const Tensor &means, &scales, &quaternions, &opacities, &sh, &w2c, &intrinsics;
  int64_t width, height;
  double eps2d;

  // Throws on shapes and numbers that don't fit.
  void check() const;

  bool is_double() const { return means.scalar_type() == torch::kDouble; }

  // On the CPU, contiguous, of one type: float64 where the means are, float32 else. Moving and converting are
  // differentiable, so gradients go back to the caller's device and type. Cameras get none.
  tensor_list on_host() const {
    const auto type = is_double() ? torch::kDouble : torch::kFloat;
    const auto host = [&](const Tensor& t) { return t.to(torch::kCPU, type).contiguous(); };
    return {host(means), host(scales), host(quaternions), host(opacities), host(sh), host(w2c.detach()),
            host(intrinsics.detach())};
  }
};

Arguments borrowed(const SplatArguments& of);

// Checks the arguments, runs the autograd function of their scalar type, and leaves its results, on the device of the
// means, to the caller. Function<T>::apply takes (means, …, intrinsics, width, height, eps2d).
template <template <class> class Function>
void run(const Arguments& a, rust::Slice<size_t> out) {
  a.check();
  const tensor_list t = a.on_host();
  const auto apply = [&](auto function) {
    return decltype(function)::apply(t[0], t[1], t[2], t[3], t[4], t[5], t[6], a.width, a.height, a.eps2d);
  };
  const tensor_list results = a.is_double() ? apply(Function<double>{}) : apply(Function<float>{});
  for (size_t k = 0; k < out.size(); ++k)
    out[k] = reinterpret_cast<size_t>(new Tensor(results[k].to(a.means.device())));
}

// The rasterizer's view of the Gaussian tensors `t` (means, scales, quaternions, opacities, sh), one item per scene.
template <class T>
std::vector<raster::Gaussians<T>> scenes_of(const tensor_list& t) {
  std::vector<raster::Gaussians<T>> scenes;
  const int64_t count = t[0].size(1), bases = t[4].size(2);
  for (int64_t b = 0; b < t[0].size(0); ++b)
    scenes.push_back({t[0].data_ptr<T>() + b * count * 3, t[1].data_ptr<T>() + b * count * 3,
                      t[2].data_ptr<T>() + b * count * 4, t[3].data_ptr<T>() + b * count,
                      t[4].data_ptr<T>() + b * count * bases * 3, count, int(bases)});
  return scenes;
}

// The same for gradients.
template <class T>
std::vector<raster::GaussianGradients<T>> gradients_of(const tensor_list& t) {
  std::vector<raster::GaussianGradients<T>> scenes;
  const int64_t count = t[0].size(1), bases = t[4].size(2);
  for (int64_t b = 0; b < t[0].size(0); ++b)
    scenes.push_back({t[0].data_ptr<T>() + b * count * 3, t[1].data_ptr<T>() + b * count * 3,
                      t[2].data_ptr<T>() + b * count * 4, t[3].data_ptr<T>() + b * count,
                      t[4].data_ptr<T>() + b * count * bases * 3});
  return scenes;
}

template <class T>
std::vector<raster::View<T>> views_of(const Tensor& w2c, const Tensor& intrinsics) {
  std::vector<raster::View<T>> views;
  const int64_t scenes = w2c.size(0), cameras = w2c.size(1);
  for (int64_t b = 0; b < scenes; ++b)
    for (int64_t c = 0; c < cameras; ++c) {
      const T* m = w2c.data_ptr<T>() + (b * cameras + c) * 16;
      const T* k = intrinsics.data_ptr<T>() + (b * cameras + c) * 9;
      views.push_back({{{m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]},
                        {m[3], m[7], m[11]},
                        k[0], k[4], k[2], k[5]},
                       int(b)});
    }
  return views;
}

}  // namespace globalsplat
