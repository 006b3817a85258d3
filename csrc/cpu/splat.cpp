// The CPU backend: it runs the rasterizer of kernels/ on tensors' memory.
#include <ATen/ops/empty.h>

#include <chrono>
#include <memory>
#include <numeric>
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

// Calls body(0.) or body(0.f), depending on the type of the inputs.
template <class Body>
auto dispatch_by_type(const Inputs& in, Body body) {
  return in.gaussians.means.scalar_type() == at::kDouble ? body(0.) : body(0.f);
}

// Times of this thread's last call and of its backward pass, which autograd runs on the thread that requested it.
thread_local raster::StageTimes last_times;

template <class T>
struct SavedFrame : SavedState {
  SavedFrame(const Inputs& in, const RenderOutput& out)
      : frame(arguments_of<T>(in), get_num_threads(), pictures_of<T>(out), last_times) {}
  raster::Frame<T> frame;
};

std::unique_ptr<const SavedState> splat(const Inputs& in, const RenderOutput& out) {
  return dispatch_by_type(in, [&](auto number) -> std::unique_ptr<const SavedState> {
    return std::make_unique<SavedFrame<decltype(number)>>(in, out);
  });
}

void splat_backward(const Inputs& in, const RenderOutput& outputs, const RenderOutput& gradients, const SavedState& saved,
                    const Gradients& out) {
  dispatch_by_type(in, [&](auto number) {
    using T = decltype(number);
    static_cast<const SavedFrame<T>&>(saved).frame.backward(arguments_of<T>(in), pictures_of<const T>(outputs),
                                                            pictures_of<const T>(gradients), gradients_of<T>(out), data<T>(out.w2c),
                                                            last_times);
  });
}

template <class T>
Tensor project_as(const Inputs& in) {
  const raster::Arguments<T> of = arguments_of<T>(in);
  const Tensor splats = at::empty({of.scenes, of.cameras, in.count(), int64_t(sizeof(raster::Splat<T>) / sizeof(T))},
                                  in.gaussians.means.options());
  std::vector<raster::ProjectionParams<T>> params;  // of the views of a scene
  std::vector<raster::Splat<T>*> of_views;
  for (int64_t view = 0; view < of.scenes * of.cameras; ++view) {
    const raster::Camera<T> camera = raster::camera_of(of.w2c + 16 * view, of.intrinsics + 9 * view);
    params.push_back(raster::make_projection_params(camera, of.width, of.height, of.projection));
    of_views.push_back(reinterpret_cast<raster::Splat<T>*>(data<T>(splats)) + view * in.count());
  }
  for (int64_t scene = 0; scene < of.scenes; ++scene)
    raster::kernels().of<T>().project(of.gaussians.of_scene(scene), 0, in.count(), params.data() + scene * of.cameras, of.cameras,
                                      of_views.data() + scene * of.cameras);
  return splats;
}

Tensor project(const Inputs& in) {
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
  const raster::PairCounts counts = cpu::SavedFrame<float>(in, empty_output(in)).frame.count_pairs();
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
