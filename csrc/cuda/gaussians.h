// Projection of Gaussians to splats, forward and backward: the maths of kernels/project.h with one Gaussian per thread.
#pragma once

#include "project.h"
#include "projection_params.h"
#include "warp.h"

namespace globalsplat::cuda {

// Calls body(g) with a number of spherical harmonics that is a compile-time constant, so that loops over them keep values in registers.
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

// Computes the projection parameters, one view per thread. If `tile_counts` isn't null, sets it to 0 for every tile of every view, plus one
// element.
__global__ void gs_lenses(Call call, ProjectionSettings projection, const float* w2c, const float* intrinsics,
                          ProjectionParams<float>* params, uint32_t* tile_counts) {
  const int64_t k = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (k < call.views)
    params[k] = raster::make_projection_params(raster::camera_of(w2c + 16 * k, intrinsics + 9 * k), call.grid.width, call.grid.height,
                                               projection);
  if (tile_counts != nullptr && k <= int64_t(call.views) * call.grid.tiles()) tile_counts[k] = 0;
}

// Projects Gaussians, with one row of blocks per view.
__global__ void __launch_bounds__(kGaussianThreads)
    gs_project(Call call, Gaussians<float> gaussians, const ProjectionParams<float>* params, Splat<float>* splats) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x, view = blockIdx.y;
  if (i >= call.count) return;
  // Stored as a whole, four values at a time.
  Splat<float> own;
  with_bases(gaussians.of_scene(view / call.cameras), [&](const Gaussians<float>& g) {
    Splat<float>* const place = &own;
    raster::lane::project({g.means + 3 * i, g.scales + 3 * i, g.quaternions + 4 * i, g.opacities + i, g.sh + 3 * g.bases * i,
                           1, g.bases},
                          0, 1, params + view, 1, &place);
  });
  splats[view * call.count + i] = own;
}

// Computes the gradients of Gaussians, with one row of blocks per scene. The records of Gaussian i in a view are first[view·N + i] …
// first[view·N + i + 1] − 1. If `camera_gradients` isn't null, it receives the gradients of the views' cameras from the Gaussians of every
// warp: [views, warps of a view].
//
// With several cameras, the warps of a block process the same Gaussians and divide the cameras among themselves; their sums are added in
// the warps' order. Spherical harmonics, three quarters of all values, go through shared memory, which makes their global memory accesses
// contiguous.
__global__ void __launch_bounds__(kGaussianThreads, 4)
    gs_project_backward(Call call, Gaussians<float> gaussians, const ProjectionParams<float>* params, const Splat<float>* splats,
                        const SplatGradient<float>* records, const uint32_t* first, GaussianGradients<float> out,
                        CameraGradient<float>* camera_gradients) {
  constexpr int kWarps = kGaussianThreads / kWarp, kRow = 3 * raster::kMaxBases + 1;  // odd, which avoids bank conflicts
  constexpr int kSums = 14;
  struct Shared {
    float sh[kWarps][kWarp][kRow];  // sums of gradients
    union {
      float of_all[kWarp][kRow];    // coefficients, shared by the warps
      float sums[kWarps][kSums][kWarp];
    };
  };
  GS_SHARED(Shared, shared, [1]);
  auto& memory = shared[0];
  const bool is_dealt = call.cameras > 1;
  const int sharing = is_dealt ? kWarps : 1, member = warp() % sharing;  // number of warps with the same Gaussians, and index among them
  const int64_t begin = (int64_t(blockIdx.x) * kWarps + warp() - member) / sharing * kWarp;
  const int64_t view = int64_t(blockIdx.y) * call.cameras, i = begin + lane(), groups = ceil_div(call.count, kWarp);
  // Excess threads have no Gaussian, but take part in sums.
  const bool is_there = i < call.count;
  const int there = int(begin >= call.count ? 0 : call.count - begin < kWarp ? call.count - begin : kWarp);
  float(&sums_of_sh)[kRow] = memory.sh[warp()][lane()];
  float(*const coefficients)[kRow] = is_dealt ? memory.of_all : memory.sh[warp()];

  with_bases(gaussians.of_scene(blockIdx.y), [&](const Gaussians<float>& scene) {
    const int width = 3 * scene.bases, own = lane() + member * kWarp;
    for (int k = own; k < there * width; k += sharing * kWarp)
      coefficients[k / width][k % width] = scene.sh[begin * width + k];
    __syncthreads();

    raster::lane::GroupGradient<float> sum;
    bool ever = false;
    for (int64_t k = member; k < call.cameras; k += sharing) {
      const int64_t place = (view + k) * call.count + i;
      const uint32_t from = is_there ? first[place] : 0, to = is_there ? first[place + 1] : 0;
      float d[raster::kSplatGradientNumbers] = {}, d_mean2d[2] = {}, of_camera[raster::kCameraNumbers] = {};
      for (uint32_t record = from; record < to; ++record) {
        const auto* const numbers = reinterpret_cast<const FloatPair*>(records + record);
        for (int n = 0; n < raster::kSplatGradientNumbers; ++n) d[n] += numbers[n / 2].numbers[n % 2];
      }
      if (from < to) {
        // Recomputing and rereading values frees registers in between.
        raster::lane::Group<float> group;
        raster::lane::Projection<float> projection{};  // only visible Gaussians have records
        raster::lane::Shading<float> shading;
        const ProjectionParams<float>& of_view = params[view + k];
        float d_r[3];
        const Splat<float>& splat = splats[place];
        const auto is_unclamped = [&](float color) { return of_view.direct_colors || color > 0; };
        for (int n = 0; n < 3; ++n) group.mean[n] = scene.means[3 * i + n];
        raster::lane::compute_directions(group, scene.bases, of_view, true, shading);
        raster::lane::shade_group_backward<float>(
            scene.bases, shading, {is_unclamped(splat.red), is_unclamped(splat.green), is_unclamped(splat.blue)}, d,
            [&](int n) { return coefficients[lane()][n]; },
            [&](int n, float x, float y) { sums_of_sh[n] = raster::lane::add_product(x, y, ever ? sums_of_sh[n] : 0); }, d_r);
        raster::lane::load_shapes(scene, i, i + 1, group);
        raster::lane::project_group(group, of_view, projection);
        raster::lane::project_group_backward(group, of_view, projection, true, d, d_r, sum, d_mean2d, camera_gradients != nullptr,
                                             of_camera);
        ever = true;
      }
      if (out.means2d != nullptr && is_there)
        for (int n = 0; n < 2; ++n) out.means2d[2 * place + n] = d_mean2d[n];
      if (camera_gradients != nullptr) {
        const WarpReduction<raster::kCameraNumbers, kWarp> fold;
        const float number = fold(of_camera);
        if (fold.which >= 0 && begin < call.count) camera_gradients[(view + k) * groups + begin / kWarp].numbers[fold.which] = number;
      }
    }
    if (!ever)
      for (int n = 0; n < width; ++n) sums_of_sh[n] = 0;
    __syncthreads();

    // Writes the sums over warps to global memory. The result of keep_in_register() can't have been computed earlier, so it has occupied no
    // registers.
    const auto at = out.of_scene(scene, keep_in_register(int(blockIdx.y)));
    for (int k = own; k < there * width; k += sharing * kWarp) {
      float number = 0;
      for (int n = 0; n < sharing; ++n) number += memory.sh[warp() - member + n][k / width][k % width];
      at.sh[begin * width + k] = number;
    }
    if (is_dealt) {
      float(&own_sums)[kSums][kWarp] = memory.sums[warp()];
      for (int n = 0; n < 3; ++n) own_sums[n][lane()] = sum.mean[n];
      for (int n = 0; n < 9; ++n) own_sums[3 + n][lane()] = sum.axes[n];
      own_sums[12][lane()] = sum.opacity;
      own_sums[13][lane()] = ever ? 1.0f : 0.0f;
      __syncthreads();
      if (member != 0) return;
      const auto total = [&](int number) {
        float all = 0;
        for (const auto& of_warp : memory.sums) all += of_warp[number][lane()];
        return all;
      };
      for (int n = 0; n < 3; ++n) sum.mean[n] = total(n);
      for (int n = 0; n < 9; ++n) sum.axes[n] = total(3 + n);
      sum.opacity = total(12);
      ever = total(13) > 0;
    }
    if (!is_there) return;
    float d_scale[3] = {}, d_quaternion[4] = {};
    if (ever) {
      raster::lane::Group<float> group;
      raster::lane::load_shapes(scene, i, i + 1, group);
      raster::lane::axes_backward<float>(group, sum.axes, d_scale, d_quaternion);
    }
    for (int n = 0; n < 3; ++n) at.means[3 * i + n] = sum.mean[n];
    for (int n = 0; n < 3; ++n) at.scales[3 * i + n] = d_scale[n];
    for (int n = 0; n < 4; ++n) at.quaternions[4 * i + n] = d_quaternion[n];
    at.opacities[i] = sum.opacity;
  });
}

// Computes the gradient of one element of w2c per warp, summed over the gradients from all warps.
__global__ void gs_sum_cameras(int views, int warps, const CameraGradient<float>* camera_gradients, float* w2c) {
  const int64_t number = (int64_t(blockIdx.x) * blockDim.x + threadIdx.x) / kWarp;
  if (number >= int64_t(views) * 16) return;
  const int64_t view = number / 16, row = number % 16 / 4, column = number % 4;
  double sum = 0;
  if (row < 3)
    for (int64_t k = lane(); k < warps; k += kWarp)
      sum += camera_gradients[view * warps + k].numbers[column < 3 ? 3 * row + column : 9 + row];
  for (int step = kWarp / 2; step > 0; step /= 2) sum += __shfl_xor_sync(kAll, sum, step);
  if (lane() == 0) w2c[number] = float(sum);
}

}  // extern "C"
}  // namespace globalsplat::cuda
