// Declarations that host and kernels share: the parameters of a call, and every kernel's name and arguments.
#pragma once

#include "types.h"

// Kernels are ordinary functions in C++ code that only launches them.
#if !defined(__CUDACC__) && !defined(GS_EMULATED)
#define __global__
#endif

namespace globalsplat::cuda {

using raster::CameraGradient;
using raster::LossJob;
using raster::GaussianGradients;
using raster::Gaussians;
using raster::Grid;
using raster::ProjectionParams;
using raster::ProjectionSettings;
using raster::RenderOutput;
using raster::Splat;
using raster::SplatGradient;
using raster::TileEntry;

// Parameters of a call. Gaussians, splats, images and their gradients of all scenes and views are consecutive, as in the op's tensors.
struct Call {
  int views;    // scenes · cameras
  int cameras;  // per scene
  int count;    // Gaussians per scene
  int bases;    // spherical harmonics per channel
  Grid grid;
};

inline constexpr int kWarp = 32;
inline constexpr int kGaussianThreads = 128;  // per block with one Gaussian per thread
inline constexpr int kTileThreads = 256;      // per block with one tile, one pixel per thread
inline constexpr int kSortThreads = 256;      // per block that sorts a tile's list
inline constexpr int kListKeys = 2048;        // maximum length of a list that is sorted in shared memory
inline constexpr int kScanThreads = 512;      // per block that sums counts
inline constexpr int kScanItems = 4;          // counts per thread
inline constexpr int kLossThreads = 256;      // per block that compares images with photos
inline constexpr int kLossColumns = 32;       // windows or pixels per such block
inline constexpr int kLossRows = 16;

// Sort key of a tile's pairs: the bits of the depth, a positive float, then the index among all pairs, which are ordered by Gaussian.
inline constexpr uint64_t key_of(uint32_t depth, uint32_t pair) { return uint64_t(depth) << 32 | pair; }
inline constexpr uint32_t pair_of(uint64_t key) { return uint32_t(key); }

// Planes [H, W] of images and of photos, and the weights of SSIM's window in each direction.
struct PhotometricPlanes {
  const float* pictures;
  const float* photos;
  int width, height;
  float window[raster::kWindow];
};

// Counts, and the output for their exclusive prefix sums.
struct Counts {
  int64_t length;
  const uint32_t* counts;
  uint32_t* sums;
};

// Returns the number of warps or blocks for `items` items, with `of` items each.
inline constexpr int ceil_div(int64_t items, int of) { return int((items + of - 1) / of); }

// Kernels, documented where they are defined: gaussians.h, tile_lists.h, losses.h, sort.h, tiles.h.
extern "C" {
__global__ void gs_lenses(Call, ProjectionSettings, const float* w2c, const float* intrinsics,
                          ProjectionParams<float>* params, uint32_t* tile_counts);
__global__ void gs_project(Call, Gaussians<float>, const ProjectionParams<float>* params, Splat<float>* splats);
__global__ void gs_cover(Call, const Splat<float>* splats, uint32_t* group_pairs, uint32_t* of_tiles, uint32_t* first,
                         uint64_t* keys, TileEntry* pairs);
__global__ void gs_scan(Counts first, Counts second, uint64_t* total);
__global__ void gs_sort_lists(Call, const uint32_t* tile_start, uint64_t* keys, uint64_t* spare, const TileEntry* pairs,
                              TileEntry* entries);
__global__ void gs_blend(Call, const Splat<float>* splats, const TileEntry* entries, const uint32_t* tile_start,
                         RenderOutput<float> out);
__global__ void gs_blend_backward(Call, const Splat<float>* splats, const TileEntry* entries, const uint32_t* tile_start,
                                  RenderOutput<const float> pictures, RenderOutput<const float> gradients,
                                  SplatGradient<float>* records);
__global__ void gs_project_backward(Call, Gaussians<float>, const ProjectionParams<float>* params, const Splat<float>* splats,
                                    const SplatGradient<float>* records, const uint32_t* first,
                                    GaussianGradients<float> out, CameraGradient<float>* camera_gradients);
__global__ void gs_ssim(PhotometricPlanes, double each, float* slopes, double* parts);
__global__ void gs_fit_gradient(PhotometricPlanes, const float* slopes, double l1_weight, float ssim_weight, float* gradient,
                                double* parts);
__global__ void gs_unevenness(LossJob<float>, double each, float* gradient, double* parts);
__global__ void gs_sum_cameras(int views, int warps, const CameraGradient<float>* camera_gradients, float* w2c);
}

}  // namespace globalsplat::cuda

#if !defined(__CUDACC__) && !defined(GS_EMULATED)
#undef __global__
#endif
