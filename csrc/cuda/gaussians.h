// Gaussians to splats, and back: the maths of raster/project.h, a Gaussian a thread.
#pragma once

#include "lens.h"
#include "project.h"
#include "warp.h"

namespace globalsplat::cuda {

// Those of one scene.
inline Gaussians<float> scene_of(const Gaussians<float>& all, int64_t scene) {
  const int64_t first = scene * all.count;
  return {all.means + 3 * first,
          all.scales + 3 * first,
          all.quaternions + 4 * first,
          all.opacities + first,
          all.sh + 3 * all.bases * first,
          all.count,
          all.bases};
}

inline GaussianGradients<float> scene_of(const GaussianGradients<float>& all, const Gaussians<float>& of, int64_t scene) {
  const int64_t first = scene * of.count;
  return {all.means + 3 * first, all.scales + 3 * first, all.quaternions + 4 * first, all.opacities + first,
          all.sh + 3 * of.bases * first};
}

// Calls body(g) where the compiler knows how many spherical harmonics there are: then their loops need no memory.
template <class Body>
inline void with_bases(Gaussians<float> g, const Body& body) {
  switch (g.bases) {
    case 1: g.bases = 1; return body(g);
    case 4: g.bases = 4; return body(g);
    case 9: g.bases = 9; return body(g);
    default: g.bases = 16; return body(g);
  }
}

extern "C" {

// A view a thread.
__global__ void gs_lenses(Call call, float eps2d, const float* w2c, const float* intrinsics, Lens<float>* lenses) {
  const int64_t view = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (view >= call.views) return;
  lenses[view] = raster::lens_of(raster::camera_of(w2c + 16 * view, intrinsics + 9 * view), call.grid.width,
                                 call.grid.height, double(eps2d));
}

// A row of blocks a view.
__global__ void __launch_bounds__(kGaussianThreads)
    gs_project(Call call, Gaussians<float> gaussians, const Lens<float>* lenses, Splat<float>* splats) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x, view = blockIdx.y;
  if (i >= call.count) return;
  // Written in one piece, four numbers at a time.
  Splat<float> own;
  with_bases(scene_of(gaussians, view / call.cameras), [&](const Gaussians<float>& g) {
    Splat<float>* const place = &own;
    raster::lane::project({g.means + 3 * i, g.scales + 3 * i, g.quaternions + 4 * i, g.opacities + i, g.sh + 3 * g.bases * i,
                           1, g.bases},
                          0, 1, lenses + view, 1, &place);
  });
  splats[view * call.count + i] = own;
}

// A row of blocks a scene. The records of Gaussian i in a view are first[view·N + i] … first[view·N + i + 1] − 1. Where `asked`
// isn't null, it receives what the Gaussians of every warp ask of the views' cameras: [views, warps of a view].
__global__ void __launch_bounds__(kGaussianThreads)
    gs_project_backward(Call call, Gaussians<float> gaussians, const Lens<float>* lenses, const SplatGradient<float>* records,
                        const uint32_t* first, GaussianGradients<float> out, CameraGradient<float>* asked) {
  const int64_t thread = int64_t(blockIdx.x) * blockDim.x + threadIdx.x, view = int64_t(blockIdx.y) * call.cameras;
  // Threads that are left over have no Gaussian, but take part in sums.
  const int64_t i = thread < call.count ? thread : call.count, end = i < call.count ? i + 1 : i;
  const int64_t warps = parts(call.count, kWarp), own_warp = thread / kWarp;
  const auto records_of = [&](int64_t k) {
    return raster::SplatRecords<float>{records, first + (view + k) * call.count};
  };
  const Fold<raster::kCameraNumbers, kWarp> fold;
  const auto sum_over_warp = [&](int64_t k, const float(&numbers)[raster::kCameraNumbers]) {
    const float sum = fold(numbers);
    if (fold.which >= 0 && own_warp < warps) asked[(view + k) * warps + own_warp].numbers[fold.which] = sum;
  };
  with_bases(scene_of(gaussians, blockIdx.y), [&](const Gaussians<float>& scene) {
    raster::lane::project_backward_group(scene, i, end, lenses + view, call.cameras, records_of,
                                         scene_of(out, scene, blockIdx.y), asked != nullptr, sum_over_warp);
  });
}

// A number of w2c a warp: what all warps ask.
__global__ void gs_sum_cameras(int views, int warps, const CameraGradient<float>* asked, float* w2c) {
  const int64_t number = (int64_t(blockIdx.x) * blockDim.x + threadIdx.x) / kWarp;
  if (number >= int64_t(views) * 16) return;
  const int64_t view = number / 16, row = number % 16 / 4, column = number % 4;
  double sum = 0;
  if (row < 3)
    for (int64_t k = lane(); k < warps; k += kWarp)
      sum += asked[view * warps + k].numbers[column < 3 ? 3 * row + column : 9 + row];
  for (int step = kWarp / 2; step > 0; step /= 2) sum += __shfl_xor_sync(kAll, sum, step);
  if (lane() == 0) w2c[number] = float(sum);
}

}  // extern "C"
}  // namespace globalsplat::cuda
