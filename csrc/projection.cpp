#include "projection.h"

#include <algorithm>
#include <vector>

#include "marshal.h"
#include "raster/project.h"

namespace globalsplat {
namespace {

using torch::autograd::AutogradContext;

constexpr size_t kInputs = 10;

// Calls visit(view, Gaussian, its place in [B, C, N], projection, splat) for every visible pair.
template <class T, class Visit>
void for_each_visible(const tensor_list& gaussians, const Tensor& w2c, const Tensor& intrinsics, int width, int height,
                      double eps2d, Visit visit) {
  const auto scenes = scenes_of<T>(gaussians);
  int64_t place = 0;
  for (const auto& view : views_of<T>(w2c, intrinsics)) {
    const raster::Gaussians<T>& scene = scenes[size_t(view.scene)];
    const raster::Lens<T> lens(view.camera, width, height, T(eps2d));
    for (int64_t i = 0; i < scene.count; ++i, ++place) {
      raster::Projection<T> projection;
      raster::Splat<T> splat;
      if (raster::project(scene, i, lens, projection, splat)) visit(scene, lens, view.scene, i, place, projection, splat);
    }
  }
}

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
    for_each_visible<T>(
        {means, scales, quaternions, opacities, sh}, w2c, intrinsics, int(width), int(height), eps2d,
        [&](const auto&, const auto&, int, int64_t, int64_t at, const auto& p, const auto& s) {
          visible.data_ptr<int64_t>()[at] = 1;
          const T mean_values[] = {s.u, s.v}, colour_values[] = {s.red, s.green, s.blue};
          const T conic_values[] = {p.cov_yy / p.determinant, -p.cov_xy / p.determinant, p.cov_xx / p.determinant};
          std::copy_n(mean_values, 2, mean2d.data_ptr<T>() + 2 * at);
          std::copy_n(conic_values, 3, conic.data_ptr<T>() + 3 * at);
          depth.data_ptr<T>()[at] = s.z;
          std::copy_n(colour_values, 3, colour.data_ptr<T>() + 3 * at);
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
    const tensor_list gaussians(saved.begin(), saved.begin() + 5);
    tensor_list out;
    for (const Tensor& t : gaussians) out.push_back(torch::zeros_like(t));
    for (Tensor& t : g)
      if (t.defined()) t = t.contiguous();
    const int64_t count = gaussians[0].size(1), bases = gaussians[4].size(2);
    for_each_visible<T>(
        gaussians, saved[5], saved[6], int(ctx->saved_data["width"].toInt()), int(ctx->saved_data["height"].toInt()),
        ctx->saved_data["eps2d"].toDouble(),
        [&](const auto& scene, const auto& lens, int b, int64_t i, int64_t at, const auto& p, const auto& s) {
          const T *d_mean = g[1].data_ptr<T>() + 2 * at, *d_conic = g[2].data_ptr<T>() + 3 * at;
          const T* d_colour = g[4].data_ptr<T>() + 3 * at;
          // The sums over pixels that project_backward() turns into just these gradients. With U = [[a, b], [0, c]]:
          // ∂L/∂(u, v) = 2UᵀM, and W = 2UNUᵀ for N = ∂L/∂(Σ2D⁻¹), where the one number xy stands for two entries.
          raster::SplatGradient<T> d{};
          d.power_p = d_mean[0] / (2 * s.a);
          d.power_r = (d_mean[1] - 2 * s.b * d.power_p) / (2 * s.c);
          d.power_pp = 2 * (s.a * s.a * d_conic[0] + s.a * s.b * d_conic[1] + s.b * s.b * d_conic[2]);
          d.power_pr = s.a * s.c * d_conic[1] + 2 * s.b * s.c * d_conic[2];
          d.power_rr = 2 * s.c * s.c * d_conic[2];
          d.red = d_colour[0];
          d.green = d_colour[1];
          d.blue = d_colour[2];
          d.z = g[3].data_ptr<T>()[at];
          raster::GaussianGradient<T> sum;
          raster::project_backward(scene, i, lens, p, s, d, sum);
          const auto add = [&](Tensor& t, const T* values, int64_t width) {
            T* to = t.data_ptr<T>() + (b * count + i) * width;
            for (int64_t k = 0; k < width; ++k) to[k] += values[k];
          };
          add(out[0], sum.mean, 3);
          add(out[1], sum.scale, 3);
          add(out[2], sum.quaternion, 4);
          add(out[4], sum.sh, 3 * bases);
        });
    out.resize(kInputs);
    return out;
  }
};

}  // namespace

void project(size_t means, size_t scales, size_t quaternions, size_t opacities, size_t sh, size_t w2c,
             size_t intrinsics, int32_t width, int32_t height, double eps2d, rust::Slice<size_t> out) {
  run<ProjectFunction>({borrowed(means), borrowed(scales), borrowed(quaternions), borrowed(opacities), borrowed(sh),
       borrowed(w2c), borrowed(intrinsics), width, height, eps2d},
      out);
}

}  // namespace globalsplat
