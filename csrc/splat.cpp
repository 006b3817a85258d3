#include "splat.h"

#include <algorithm>
#include <memory>
#include <type_traits>
#include <vector>

#include "globalsplat/src/render/bridge.rs.h"
#include "marshal.h"
#include "raster/kernels.h"
#include "raster/sh.h"

namespace globalsplat {
namespace {

using torch::autograd::AutogradContext;

// Of this thread's last call and of its backward pass, which autograd runs on the thread that asked for it.
thread_local raster::StageTimes last_times;

constexpr size_t kInputs = 10;  // kGaussianInputs, w2c, intrinsics, width, height, eps2d

// rgb [B, C, 3, H, W], alpha and depth [B, C, H, W] as one item per view.
template <class Pixel>
std::vector<raster::Pictures<Pixel>> pictures_of(const Tensor& rgb, const Tensor& alpha, const Tensor& depth) {
  using T = std::remove_const_t<Pixel>;
  std::vector<raster::Pictures<Pixel>> pictures;
  const int64_t views = rgb.size(0) * rgb.size(1), pixels = rgb.size(3) * rgb.size(4);
  for (int64_t k = 0; k < views; ++k)
    pictures.push_back({rgb.data_ptr<T>() + k * 3 * pixels, alpha.data_ptr<T>() + k * pixels,
                        depth.data_ptr<T>() + k * pixels});
  return pictures;
}

// Keeps a raster::Frame alive between forward and backward.
template <class T>
struct FrameHolder : torch::CustomClassHolder {
  explicit FrameHolder(std::unique_ptr<raster::Frame<T>> f) : frame(std::move(f)) {}
  std::unique_ptr<raster::Frame<T>> frame;
};

template <class T>
struct SplatFunction : torch::autograd::Function<SplatFunction<T>> {
  // All tensors on the CPU, contiguous, of element type T.
  static tensor_list forward(AutogradContext* ctx, Tensor means, Tensor scales, Tensor quaternions, Tensor opacities,
                             Tensor sh, Tensor w2c, Tensor intrinsics, int64_t width, int64_t height, double eps2d) {
    const auto options = means.options();
    const int64_t scenes = w2c.size(0), cameras = w2c.size(1);
    Tensor rgb = torch::empty({scenes, cameras, 3, height, width}, options);
    Tensor alpha = torch::empty({scenes, cameras, height, width}, options), depth = torch::empty_like(alpha);
    const raster::Settings settings{int(width), int(height), eps2d, torch::get_num_threads()};
    auto frame = raster::Frame<T>::draw(scenes_of<T>({means, scales, quaternions, opacities, sh}),
                                        views_of<T>(w2c, intrinsics), settings, pictures_of<T>(rgb, alpha, depth),
                                        last_times);
    ctx->save_for_backward({means, scales, quaternions, opacities, sh, rgb, alpha, depth});
    ctx->saved_data["frame"] =
        c10::IValue::make_capsule(c10::make_intrusive<FrameHolder<T>>(std::move(frame)));
    return {rgb, alpha, depth};
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list gradients) {
    const tensor_list saved = ctx->get_saved_variables();
    const tensor_list gaussians(saved.begin(), saved.begin() + kGaussianInputs);
    const auto holder = c10::static_intrusive_pointer_cast<FrameHolder<T>>(ctx->saved_data["frame"].toCapsule());
    tensor_list out;
    for (const Tensor& t : gaussians) out.push_back(torch::empty_like(t));
    for (Tensor& g : gradients) g = g.contiguous();
    holder->frame->backward(scenes_of<T>(gaussians), pictures_of<const T>(saved[5], saved[6], saved[7]),
                            pictures_of<const T>(gradients[0], gradients[1], gradients[2]), gradients_of<T>(out),
                            last_times);
    out.resize(kInputs);  // undefined: no gradient for cameras and numbers
    return out;
  }
};

}  // namespace

void splat(const SplatArguments& of, rust::Slice<size_t> out) {
  run<SplatFunction>(borrowed(of), out);
}

void sh_basis(const std::array<double, 3>& direction, rust::Slice<double> out) {
  double values[raster::kMaxBases];
  raster::sh_basis<double>(int(out.size()), direction.data(), values);
  std::copy_n(values, out.size(), out.data());
}

PairCounts count_pairs(const SplatArguments& of) {
  const Arguments a = borrowed(of);
  a.check();
  TORCH_CHECK(!a.is_double(), "pairs are counted as float32 sees them");
  const tensor_list t = a.on_host();
  const int64_t scenes = a.w2c.size(0), cameras = a.w2c.size(1);
  const Tensor rgb = torch::empty({scenes, cameras, 3, of.height, of.width});
  const Tensor alpha = torch::empty({scenes, cameras, of.height, of.width});
  const Tensor depth = torch::empty_like(alpha);
  raster::StageTimes unused;
  const raster::PairCounts counts =
      raster::Frame<float>::draw(scenes_of<float>(t), views_of<float>(t[5], t[6]),
                                 {of.width, of.height, of.eps2d, torch::get_num_threads()},
                                 pictures_of<float>(rgb, alpha, depth), unused)
          ->count();
  return {counts.tile_entries, counts.evaluated, counts.contributing};
}

double multiply_add_peak(double seconds) { return raster::multiply_add_peak(torch::get_num_threads(), seconds); }

StageTimes stage_times() {
  const raster::StageTimes& t = last_times;
  return {t.project, t.sort, t.bin, t.blend, t.blend_backward, t.project_backward};
}

rust::String libtorch_version() { return TORCH_VERSION; }

rust::String simd_level() { return raster::kernels().name; }

}  // namespace globalsplat
