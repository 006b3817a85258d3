// What host and kernels share: a call's numbers, and every kernel's name and arguments.
#pragma once

#include "types.h"

// In C++ that only launches them, kernels are functions like others.
#if !defined(__CUDACC__) && !defined(GS_EMULATED)
#define __global__
#endif

namespace globalsplat::cuda {

using raster::CameraGradient;
using raster::GaussianGradients;
using raster::Gaussians;
using raster::Grid;
using raster::Lens;
using raster::Pictures;
using raster::Splat;
using raster::SplatGradient;
using raster::TileEntry;

// Gaussians, splats, pictures and their gradients of all scenes and views follow each other, as in the op's tensors.
struct Call {
  int views;    // scenes · cameras
  int cameras;  // of a scene
  int count;    // Gaussians of a scene
  int bases;    // of spherical harmonics
  Grid grid;
};

inline constexpr int kWarp = 32;
inline constexpr int kGaussianThreads = 128;  // of a block that takes a Gaussian a thread
inline constexpr int kTileThreads = 256;      // of a block that takes a tile, a pixel a thread
inline constexpr int kSortThreads = 256;      // of a block that sorts, and values of a digit
inline constexpr int kDigitBits = 8;
inline constexpr int kSortItems = 8;          // keys of a thread
inline constexpr int kScanItems = 8;          // numbers of a thread
inline constexpr int kDepthBits = 31;         // of a positive float's

// Where a key of the sort has a pair's tile, counted over all views; below are its depth's bits.
inline constexpr uint64_t key_of(uint64_t tile) { return tile << kDepthBits; }

// Warps that a view's Gaussians, or blocks that so many items, are dealt to.
inline constexpr int parts(int64_t items, int of) { return int((items + of - 1) / of); }

// Described where they are written: gaussians.h, cover.h, sort.h, tiles.h.
extern "C" {
__global__ void gs_lenses(Call, float eps2d, const float* w2c, const float* intrinsics, Lens<float>* lenses);
__global__ void gs_project(Call, Gaussians<float>, const Lens<float>* lenses, Splat<float>* splats);
__global__ void gs_cover(Call, const Splat<float>* splats, uint32_t* group_pairs, uint32_t* first, uint64_t* keys,
                         uint32_t* values, TileEntry* pairs);
__global__ void gs_scan(int length, uint32_t* counts, uint64_t* totals);
__global__ void gs_count_digits(uint32_t count, int shift, const uint64_t* keys, uint32_t* table);
__global__ void gs_scatter(uint32_t count, int shift, const uint64_t* keys, const uint32_t* values, const uint32_t* table,
                           const uint64_t* totals, uint64_t* sorted_keys, uint32_t* sorted_values);
__global__ void gs_list(uint32_t count, uint32_t tiles, const uint64_t* keys, const uint32_t* values, const TileEntry* pairs,
                        TileEntry* entries, uint32_t* tile_start);
__global__ void gs_blend(Call, const Splat<float>* splats, const TileEntry* entries, const uint32_t* tile_start,
                         Pictures<float> out);
__global__ void gs_blend_backward(Call, const Splat<float>* splats, const TileEntry* entries, const uint32_t* tile_start,
                                  Pictures<const float> pictures, Pictures<const float> gradients,
                                  SplatGradient<float>* records);
__global__ void gs_project_backward(Call, Gaussians<float>, const Lens<float>* lenses, const Splat<float>* splats,
                                    const SplatGradient<float>* records, const uint32_t* first,
                                    GaussianGradients<float> out, CameraGradient<float>* asked);
__global__ void gs_sum_cameras(int views, int warps, const CameraGradient<float>* asked, float* w2c);
}

}  // namespace globalsplat::cuda

#if !defined(__CUDACC__) && !defined(GS_EMULATED)
#undef __global__
#endif
