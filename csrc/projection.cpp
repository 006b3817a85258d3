#include "projection.h"

#include <vector>

#include "globalsplat/src/render/bridge.rs.h"
#include "marshal.h"
#include "raster/kernels.h"

namespace globalsplat {
namespace {

using torch::autograd::AutogradContext;

constexpr size_t kInputs = 10;

// Each scene's cameras, and every Gaussian's splat as each sees it.
template <class T>
struct Seen {
  std::vector<raster::Gaussians<T>> scenes;
  int64_t cameras;
  std::vector<raster::Lens<T>> lenses;             // [scenes · cameras]
  std::vector<std::vector<raster::Splat<T>>> splats;  // [scenes · cameras][N]

  Seen(const tensor_list& gaussians, const Tensor& w2c, const Tensor& intrinsics, int width, int height, double eps2d)
      : scenes(scenes_of<T>(gaussians)), cameras(w2c.size(1)) {
    std::vector<raster::Splat<T>*> places;
    for (const auto& view : views_of<T>(w2c, intrinsics)) {
      lenses.push_back(raster::lens_of(view.camera, width, height, eps2d));
      splats.emplace_back(size_t(gaussians[0].size(1)));
      places.push_back(splats.back().data());
    }
    for (size_t b = 0; b < scenes.size(); ++b)
      raster::kernels().of<T>().project(scenes[b], 0, scenes[b].count, lenses.data() + int64_t(b) * cameras, cameras,
                                        places.data() + int64_t(b) * cameras);
  }

  // Calls visit(view, place in [B, C, N], splat) for every visible pair.
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
struct ProjectFunction : torch::autograd::Function<ProjectFunction<T>> {
  static tensor_list forward(AutogradContext* ctx, Tensor means, Tensor scales, Tensor quaternions, Tensor opacities,
                             Tensor sh, Tensor w2c, Tensor intrinsics, int64_t width, int64_t height, double eps2d) {
    const int64_t scenes = w2c.size(0), cameras = w2c.size(1), count = means.size(1);
    const auto zeros = [&](std::vector<int64_t> tail) {
      tail.insert(tail.begin(), {scenes, cameras, count});
      return torch::zeros(tail, means.options());
    };
    Tensor visible = torch::zeros({scenes, cameras, count}, torch::kLong);
    Tensor mean2d = zeros({2}), conic = zeros({3}), depth = zeros({}), colour = zeros({3});
    const auto put = [](Tensor& to, int64_t at, std::initializer_list<T> values) {
      std::copy(values.begin(), values.end(), to.data_ptr<T>() + int64_t(values.size()) * at);
    };
    Seen<T>({means, scales, quaternions, opacities, sh}, w2c, intrinsics, int(width), int(height), eps2d)
        .for_each_visible([&](size_t, int64_t at, const raster::Splat<T>& s) {
          // Σ2D⁻¹ = 2 ln 2·UᵀU with U = [[a, b], [0, c]].
          const T two_ln2 = T(2 / raster::kLog2E);
          visible.data_ptr<int64_t>()[at] = 1;
          put(mean2d, at, {s.u, s.v});
          put(conic, at, {two_ln2 * s.a * s.a, two_ln2 * s.a * s.b, two_ln2 * (s.b * s.b + s.c * s.c)});
          put(depth, at, {s.z});
          put(colour, at, {s.red, s.green, s.blue});
        });
    ctx->save_for_backward({means, scales, quaternions, opacities, sh, w2c, intrinsics});
    ctx->saved_data["width"] = width;
    ctx->saved_data["height"] = height;
    ctx->saved_data["eps2d"] = eps2d;
    ctx->mark_non_differentiable({visible});
    return {visible, mean2d, conic, depth, colour};
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list g) {
    const tensor_list saved = ctx->get_saved_variables();
    const tensor_list gaussians(saved.begin(), saved.begin() + kGaussianInputs);
    for (Tensor& t : g)
      if (t.defined()) t = t.contiguous();
    const Seen<T> seen(gaussians, saved[5], saved[6], int(ctx->saved_data["width"].toInt()),
                       int(ctx->saved_data["height"].toInt()), ctx->saved_data["eps2d"].toDouble());

    // A record per visible Gaussian: the sums over pixels that project_backward() turns into just these gradients.
    const size_t views = seen.splats.size(), count = size_t(gaussians[0].size(1));
    std::vector<std::vector<raster::SplatGradient<T>>> records(views);
    std::vector<std::vector<uint32_t>> first(views, std::vector<uint32_t>(count + 1, 0));
    seen.for_each_visible([&](size_t view, int64_t at, const raster::Splat<T>& s) {
      const T *d_mean = g[1].data_ptr<T>() + 2 * at, *d_conic = g[2].data_ptr<T>() + 3 * at;
      const T* d_colour = g[4].data_ptr<T>() + 3 * at;
      // With Σ2D⁻¹ = 2 ln 2·UᵀU: ∂L/∂(u, v) = 2 ln 2·UᵀM, and W = 2UNUᵀ for N = ∂L/∂(Σ2D⁻¹), where the one number xy stands
      // for two entries.
      const T two_ln2 = T(2 / raster::kLog2E);
      raster::SplatGradient<T> d{};
      d.power_p = d_mean[0] / (two_ln2 * s.a);
      d.power_r = (d_mean[1] - two_ln2 * s.b * d.power_p) / (two_ln2 * s.c);
      d.power_pp = 2 * (s.a * s.a * d_conic[0] + s.a * s.b * d_conic[1] + s.b * s.b * d_conic[2]);
      d.power_pr = s.a * s.c * d_conic[1] + 2 * s.b * s.c * d_conic[2];
      d.power_rr = 2 * s.c * s.c * d_conic[2];
      d.red = d_colour[0];
      d.green = d_colour[1];
      d.blue = d_colour[2];
      d.z = g[3].data_ptr<T>()[at];
      records[view].push_back(d);
      first[view][size_t(at) % count + 1] = 1;
    });
    std::vector<raster::SplatRecords<T>> of_views;
    for (size_t view = 0; view < views; ++view) {
      for (size_t i = 0; i < count; ++i) first[view][i + 1] += first[view][i];
      of_views.push_back({records[view].data(), first[view].data()});
    }
    tensor_list out;
    for (const Tensor& t : gaussians) out.push_back(torch::empty_like(t));
    const auto places = gradients_of<T>(out);
    for (size_t b = 0; b < seen.scenes.size(); ++b) {
      const int64_t view = int64_t(b) * seen.cameras;
      raster::kernels().of<T>().project_backward(seen.scenes[b], 0, int64_t(count), seen.lenses.data() + view,
                                                 seen.cameras, of_views.data() + view, places[b]);
    }
    out.resize(kInputs);
    return out;
  }
};

}  // namespace

void project(const SplatArguments& of, rust::Slice<size_t> out) {
  run<ProjectFunction>(borrowed(of), out);
}

}  // namespace globalsplat
