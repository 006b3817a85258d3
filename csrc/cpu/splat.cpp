#include <ATen/ops/empty.h>

#include <memory>
#include <type_traits>
#include <vector>

#include "../arguments.h"
#include "../kernels/kernels.h"
#include "../threads.h"
#include "backend.h"
#include "cpu.h"
#include "globalsplat-csrc/src/render.rs.h"
#include "memory.h"

namespace globalsplat {
namespace cpu {
namespace {

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
std::unique_ptr<raster::Frame<T>> draw(const Inputs& in, RenderOutput& out, raster::StageTimes& times) {
  const auto options = in.gaussians.means.options();
  out.rgb = at::empty({in.scenes(), in.cameras(), 3, in.height, in.width}, options);
  out.alpha = at::empty({in.scenes(), in.cameras(), in.height, in.width}, options);
  out.depth = at::empty_like(out.alpha);
  const raster::Settings settings{int(in.width), int(in.height), in.projection, get_num_threads()};
  return raster::Frame<T>::draw(scenes_of<T>(in), views_of<T>(in), settings, pictures_of<T>(out), times);
}

}  // namespace

RenderOutput splat(const Inputs& in, std::unique_ptr<const SavedState>& saved) {
  return dispatch_by_type(in, [&](auto number) {
    using T = decltype(number);
    RenderOutput out;
    saved = std::make_unique<SavedFrame<T>>(draw<T>(in, out, last_times));
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

const Backend backend = {at::kCPU, splat, splat_backward, project, project_backward};

}  // namespace cpu

StageTimes stage_times() {
  const raster::StageTimes& t = cpu::last_times;
  return {t.project, t.sort, t.bin, t.blend, t.blend_backward, t.project_backward};
}

PairCounts count_pairs(const SplatArguments& of) {
  const Arguments a = borrowed(of);
  a.check();
  TORCH_CHECK(a.means.scalar_type() != at::kDouble, "pairs can be counted for float32 Gaussians only");
  RenderOutput pictures;
  raster::StageTimes times;
  const raster::PairCounts counts = cpu::draw<float>(a.to_inputs(at::kCPU), pictures, times)->count();
  return {counts.tile_entries, counts.evaluated, counts.contributing};
}

double multiply_add_peak(double seconds) { return raster::multiply_add_peak(get_num_threads(), seconds); }

rust::String simd_level() { return raster::kernels().name; }

}  // namespace globalsplat
