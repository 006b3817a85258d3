#include <ATen/ops/zeros.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "../kernels/kernels.h"
#include "../kernels/projection_params.h"
#include "backend.h"
#include "memory.h"

namespace globalsplat::cpu {
namespace {

// Cameras of each scene, and the splat of every Gaussian in each of them.
template <class T>
struct ProjectedScenes {
  std::vector<raster::Gaussians<T>> scenes;
  int64_t cameras;
  std::vector<raster::ProjectionParams<T>> params;    // [scenes · cameras]
  std::vector<std::vector<raster::Splat<T>>> splats;  // [scenes · cameras][N]

  explicit ProjectedScenes(const Inputs& in) : scenes(scenes_of<T>(in)), cameras(in.cameras()) {
    std::vector<raster::Splat<T>*> places;
    for (const auto& view : views_of<T>(in)) {
      params.push_back(raster::make_projection_params(view.camera, int(in.width), int(in.height), in.projection));
      splats.emplace_back(size_t(in.count()));
      places.push_back(splats.back().data());
    }
    for (size_t b = 0; b < scenes.size(); ++b)
      raster::kernels().of<T>().project(scenes[b], 0, scenes[b].count, params.data() + int64_t(b) * cameras, cameras,
                                        places.data() + int64_t(b) * cameras);
  }

  // Calls visit(view, index in [B, C, N], splat) for every visible pair.
  template <class Visit>
  void for_each_visible(Visit visit) const {
    int64_t place = 0;
    for (size_t view = 0; view < splats.size(); ++view)
      for (const raster::Splat<T>& splat : splats[view]) {
        if (splat.z > 0) visit(view, place, splat);
        ++place;
      }
  }
};

template <class T>
Projected project_as(const Inputs& in) {
  const auto zeros = [&](std::vector<int64_t> tail, at::TensorOptions options) {
    tail.insert(tail.begin(), {in.scenes(), in.cameras(), in.count()});
    return at::zeros(tail, options);
  };
  const auto options = in.gaussians.means.options();
  const Projected out{zeros({}, at::kLong), zeros({2}, options), zeros({3}, options), zeros({}, options), zeros({3}, options),
                      zeros({}, options), zeros({2}, options)};
  const auto put = [](const Tensor& to, int64_t at, std::initializer_list<T> values) {
    std::copy(values.begin(), values.end(), to.data_ptr<T>() + int64_t(values.size()) * at);
  };
  ProjectedScenes<T>(in).for_each_visible([&](size_t, int64_t at, const raster::Splat<T>& s) {
    // Σ2D⁻¹ = 2 ln 2·UᵀU with U = [[a, b], [0, c]].
    const T two_ln2 = T(2 / raster::kLog2E);
    out.visible.data_ptr<int64_t>()[at] = 1;
    put(out.mean2d, at, {s.u, s.v});
    put(out.conic, at, {two_ln2 * s.a * s.a, two_ln2 * s.a * s.b, two_ln2 * (s.b * s.b + s.c * s.c)});
    put(out.depth, at, {s.z});
    put(out.color, at, {s.red, s.green, s.blue});
    put(out.opacity, at, {std::exp2(s.log2_opacity)});
    // From the factor, since the inverse of a needle's conic loses all digits.
    const T slope = s.b / s.c;
    put(out.variance, at, {(1 + slope * slope) / (two_ln2 * s.a * s.a), 1 / (two_ln2 * s.c * s.c)});
  });
  return out;
}

template <class T>
Gradients project_backward_as(const Inputs& in, const Projected& gradients, GradientRequest request) {
  const ProjectedScenes<T> projected(in);
  // One record per visible Gaussian: the sums over pixels that project_backward() converts to exactly these gradients.
  const size_t views = projected.splats.size(), count = size_t(in.count());
  std::vector<std::vector<raster::SplatGradient<T>>> records(views);
  std::vector<std::vector<uint32_t>> first(views, std::vector<uint32_t>(count + 1, 0));
  projected.for_each_visible([&](size_t view, int64_t at, const raster::Splat<T>& s) {
    const T *d_mean = gradients.mean2d.data_ptr<T>() + 2 * at, *d_conic = gradients.conic.data_ptr<T>() + 3 * at;
    const T* d_color = gradients.color.data_ptr<T>() + 3 * at;
    // With Σ2D⁻¹ = 2 ln 2·UᵀU: ∂L/∂(u, v) = 2 ln 2·UᵀM, and W = 2UNUᵀ for N = ∂L/∂(Σ2D⁻¹), where the single value xy stands for two
    // entries.
    const T two_ln2 = T(2 / raster::kLog2E);
    raster::SplatGradient<T> d{};
    d.power_p = d_mean[0] / (two_ln2 * s.a);
    d.power_r = (d_mean[1] - two_ln2 * s.b * d.power_p) / (two_ln2 * s.c);
    d.power_pp = 2 * (s.a * s.a * d_conic[0] + s.a * s.b * d_conic[1] + s.b * s.b * d_conic[2]);
    d.power_pr = s.a * s.c * d_conic[1] + 2 * s.b * s.c * d_conic[2];
    d.power_rr = 2 * s.c * s.c * d_conic[2];
    d.red = d_color[0];
    d.green = d_color[1];
    d.blue = d_color[2];
    d.z = gradients.depth.data_ptr<T>()[at];
    records[view].push_back(d);
    first[view][size_t(at) % count + 1] = 1;
  });
  std::vector<raster::SplatRecords<T>> of_views;
  for (size_t view = 0; view < views; ++view) {
    for (size_t i = 0; i < count; ++i) first[view][i + 1] += first[view][i];
    of_views.push_back({records[view].data(), first[view].data()});
  }
  Gradients out{empty_like(in.gaussians), {}, {}};
  const auto places = gradients_of<T>(out);
  std::vector<raster::CameraGradient<T>> cameras(request.w2c ? views : 0);
  for (size_t b = 0; b < projected.scenes.size(); ++b) {
    const int64_t view = int64_t(b) * projected.cameras;
    raster::kernels().of<T>().project_backward(projected.scenes[b], 0, int64_t(count), projected.params.data() + view,
                                               projected.cameras, of_views.data() + view, places[b],
                                               request.w2c ? cameras.data() + view : nullptr);
  }
  if (request.w2c) out.w2c = w2c_gradient(in, cameras);
  return out;
}

}  // namespace

Projected project(const Inputs& in) {
  return dispatch_by_type(in, [&](auto number) { return project_as<decltype(number)>(in); });
}

Gradients project_backward(const Inputs& in, const Projected& gradients, GradientRequest request) {
  return dispatch_by_type(in, [&](auto number) { return project_backward_as<decltype(number)>(in, gradients, request); });
}

}  // namespace globalsplat::cpu
