// The CPU backend: it runs the rasterizer of kernels/ on tensors' memory.
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/zeros.h>
#include <ATen/ops/zeros_like.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <memory>
#include <numeric>
#include <type_traits>
#include <vector>

#include "../backend.h"
#include "../kernels/kernels.h"
#include "../kernels/parallel.h"
#include "../kernels/projection_params.h"
#include "../kernels/raster.h"
#include "../runtime.h"
#include "../splat.h"
#include "globalsplat-csrc/src/render.rs.h"

namespace globalsplat {
namespace cpu {
namespace {

// ---- tensors as plain memory ----

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
Gaussians empty_like(const Gaussians& g) {
  const auto empty = [](const Tensor& t) { return at::empty_like(t); };
  return {empty(g.means), empty(g.scales), empty(g.quaternions), empty(g.opacities), empty(g.sh)};
}

// ---- splat ----

// Times of this thread's last call and of its backward pass, which autograd runs on the thread that requested it.
thread_local raster::StageTimes last_times;

template <class T>
struct SavedFrame : SavedState {
  explicit SavedFrame(std::unique_ptr<raster::Frame<T>> f) : frame(std::move(f)) {}
  std::unique_ptr<raster::Frame<T>> frame;
};

// Returns the images, one item per view. `Pixel` is T or const T.
template <class Pixel>
std::vector<raster::RenderOutput<Pixel>> pictures_of(const RenderOutput& p) {
  using T = std::remove_const_t<Pixel>;
  std::vector<raster::RenderOutput<Pixel>> pictures;
  const int64_t views = p.rgb.size(0) * p.rgb.size(1), pixels = p.rgb.size(3) * p.rgb.size(4);
  for (int64_t k = 0; k < views; ++k)
    pictures.push_back({p.rgb.data_ptr<T>() + k * 3 * pixels, p.alpha.data_ptr<T>() + k * pixels,
                        p.depth.data_ptr<T>() + k * pixels});
  return pictures;
}

template <class T>
std::unique_ptr<raster::Frame<T>> draw(const Inputs& in, RenderOutput& out) {
  const auto options = in.gaussians.means.options();
  out.rgb = at::empty({in.scenes(), in.cameras(), 3, in.height, in.width}, options);
  out.alpha = at::empty({in.scenes(), in.cameras(), in.height, in.width}, options);
  out.depth = at::empty_like(out.alpha);
  const raster::Settings settings{int(in.width), int(in.height), in.projection, get_num_threads()};
  return raster::Frame<T>::draw(scenes_of<T>(in), views_of<T>(in), settings, pictures_of<T>(out), last_times);
}

RenderOutput splat(const Inputs& in, std::unique_ptr<const SavedState>& saved) {
  return dispatch_by_type(in, [&](auto number) {
    RenderOutput out;
    saved = std::make_unique<SavedFrame<decltype(number)>>(draw<decltype(number)>(in, out));
    return out;
  });
}

Gradients splat_backward(const Inputs& in, const RenderOutput& outputs, const RenderOutput& gradients, const SavedState& saved,
                         GradientRequest request) {
  return dispatch_by_type(in, [&](auto number) {
    using T = decltype(number);
    Gradients out{empty_like(in.gaussians), {}, {}};
    if (request.means2d) out.means2d = at::empty({in.scenes(), in.cameras(), in.count(), 2}, in.gaussians.means.options());
    std::vector<raster::CameraGradient<T>> cameras(request.w2c ? size_t(in.scenes() * in.cameras()) : 0);
    static_cast<const SavedFrame<T>&>(saved).frame->backward(
        scenes_of<T>(in), pictures_of<const T>(outputs), pictures_of<const T>(gradients), gradients_of<T>(out),
        request.w2c ? cameras.data() : nullptr, last_times);
    if (request.w2c) out.w2c = w2c_gradient(in, cameras);
    return out;
  });
}

// ---- project ----

template <class T>
Projected project_as(const Inputs& in) {
  const int64_t count = in.count();
  std::vector<raster::Splat<T>> splats(size_t(in.scenes() * in.cameras() * count));  // [B, C, N]
  std::vector<raster::ProjectionParams<T>> params;                                   // [B, C]
  std::vector<raster::Splat<T>*> of_views;
  for (const auto& view : views_of<T>(in)) {
    of_views.push_back(splats.data() + int64_t(params.size()) * count);
    params.push_back(raster::make_projection_params(view.camera, int(in.width), int(in.height), in.projection));
  }
  int64_t first = 0;  // view of a scene
  for (const auto& scene : scenes_of<T>(in)) {
    raster::kernels().of<T>().project(scene, 0, count, params.data() + first, in.cameras(), of_views.data() + first);
    first += in.cameras();
  }

  const auto zeros = [&](std::vector<int64_t> tail, at::TensorOptions options) {
    tail.insert(tail.begin(), {in.scenes(), in.cameras(), count});
    return at::zeros(tail, options);
  };
  const auto options = in.gaussians.means.options();
  const Projected out{zeros({2}, options), zeros({3}, options), zeros({}, options),
                      zeros({}, options),  zeros({2}, options), zeros({}, at::kLong)};
  for (size_t at = 0; at < splats.size(); ++at) {
    const raster::Splat<T>& s = splats[at];
    if (!(s.z > 0)) continue;
    const auto put = [&](const Tensor& to, std::initializer_list<T> values) {
      std::copy(values.begin(), values.end(), to.data_ptr<T>() + values.size() * at);
    };
    // Σ2D⁻¹ = 2 ln 2·UᵀU with U = [[a, b], [0, c]].
    const T two_ln2 = T(2 / raster::kLog2E);
    put(out.mean2d, {s.u, s.v});
    put(out.conic, {two_ln2 * s.a * s.a, two_ln2 * s.a * s.b, two_ln2 * (s.b * s.b + s.c * s.c)});
    put(out.depth, {s.z});
    put(out.opacity, {std::exp2(s.log2_opacity)});
    // From the factor, since the inverse of a needle's conic loses all digits.
    const T slope = s.b / s.c;
    put(out.variance, {(1 + slope * slope) / (two_ln2 * s.a * s.a), 1 / (two_ln2 * s.c * s.c)});
    out.visible.data_ptr<int64_t>()[at] = 1;
  }
  return out;
}

Projected project(const Inputs& in) {
  return dispatch_by_type(in, [&](auto number) { return project_as<decltype(number)>(in); });
}

}  // namespace

const Backend backend = {at::kCPU, splat, splat_backward, project};

}  // namespace cpu

StageTimes stage_times() {
  const raster::StageTimes& t = cpu::last_times;
  return {t.project, t.sort, t.bin, t.blend, t.blend_backward, t.project_backward};
}

PairCounts count_pairs(const SplatArguments& of) {
  const Inputs in = borrowed(of).to_backend();
  TORCH_CHECK(in.gaussians.means.is_cpu() && in.gaussians.means.scalar_type() == at::kFloat, "pairs are counted on the CPU, in float32");
  RenderOutput out;
  const raster::PairCounts counts = cpu::draw<float>(in, out)->count_pairs();
  return {counts.tile_entries, counts.evaluated, counts.contributing};
}

double multiply_add_peak(double seconds) {
  std::vector<double> rates(static_cast<size_t>(get_num_threads()));
  raster::parallel_for(int(rates.size()), int64_t(rates.size()), [&](int64_t thread) {
    const auto start = std::chrono::steady_clock::now();
    float out = 1;
    double operations = 0, elapsed = 0;
    while (elapsed < seconds) {
      operations += double(raster::kernels().multiply_adds(1 << 16, &out));
      elapsed = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    }
    rates[size_t(thread)] = operations / elapsed;
  });
  return std::accumulate(rates.begin(), rates.end(), 0.);
}

rust::String simd_level() { return raster::kernels().name; }

}  // namespace globalsplat
