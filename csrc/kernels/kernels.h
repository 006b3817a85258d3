// Kernels that are compiled once per instruction set, and the choice among them.
#pragma once

#include "attention_types.h"
#include "types.h"

namespace globalsplat::raster {

// Kernels in the order of their use, documented where they are defined: project.h, touched_tiles.h, blend.h.
template <class T>
struct KernelsOf {
  void (*project)(const Gaussians<T>&, int64_t begin, int64_t end, const ProjectionParams<T>* params, int64_t views,
                  Splat<T>* const* splats);
  int64_t (*list_touched_tiles)(const Splat<T>* splats, int64_t begin, int64_t end, const Grid&, TilePair* pairs, int64_t capacity,
                                int64_t& used, uint32_t* first);
  void (*blend)(const TileJob<T>&, const RenderOutput<T>&);
  void (*blend_backward)(const TileJob<T>&, const RenderOutput<const T>& pictures, const RenderOutput<const T>& gradients,
                         SplatGradient<T>* records);
  void (*count_pairs)(const TileJob<T>&, PairCounts& counts);
  void (*project_backward)(const Gaussians<T>&, int64_t begin, int64_t end, const ProjectionParams<T>* params, int64_t views,
                           const SplatRecords<T>* records, const GaussianGradients<T>& out,
                           CameraGradient<T>* cameras);
  // Kernels outside of the rasterizer: ssim.h, smoothness.h, optim.h.
  double (*ssim)(const PhotometricPlane<T>&, int begin, int end, T* scratch);
  double (*photometric_gradient)(const PhotometricPlane<T>&, T l1_weight, T ssim_weight, int begin, int end, T* scratch);
  double (*unevenness)(const SmoothnessPlane<T>&, T factor, int begin, int end, T* scratch);
  void (*adam)(const AdamStep&, const AdamState<T>&, int64_t begin, int64_t end);
};

struct Kernels {
  const char* name;  // "avx512", "avx2", "neon", "portable"
  KernelsOf<float> of_float;
  KernelsOf<double> of_double;
  // attention.h
  void (*attention_forward)(const AttentionHead<float>&, Rows<float> out, float* log_sums, float* scratch);
  void (*pack_queries)(const AttentionHead<float>&, const AttentionOutputs<float>&, const PackedQueries& to);
  void (*attention_backward)(const AttentionHead<float>&, const PackedQueries&, const float* log_sums, float* dq, Rows<float> dk,
                             Rows<float> dv, float* scratch);
  // attention_bf16.h
  void (*attention_forward_bf16)(const AttentionHead<Bf16>&, const Bf16Gemm&, Rows<Bf16> out, float* log_sums, float* scratch);
  void (*pack_queries_bf16)(const AttentionHead<Bf16>&, const AttentionOutputs<Bf16>&, const float* log_sums, int64_t first, int64_t whole,
                            const PackedBf16Queries& to);
  void (*attention_backward_bf16)(const AttentionHead<Bf16>&, const Bf16Gemm&, const PackedBf16Queries&, float* dq, Rows<Bf16> dk,
                                  Rows<Bf16> dv, float* scratch);
  void (*muon)(const MuonStep&, const MuonMatrix&, float* scratch);  // optim.h
  // plane_sweep.h
  void (*sweep_planes)(const PlaneSweep&, int begin, int end, float* scores, float* scratch);
  void (*patch_variances)(const SweepPhoto&, float least_variance, float* variance, float* scratch);
  // semi_global.h
  void (*costs_of_rows)(const MatchedPhoto&, const float* scores, int begin, int end, float* costs);
  void (*sum_paths)(const MatchedPhoto&, const float* costs, bool backward, float* sums, float* scratch);
  void (*choose_planes)(const MatchedPhoto&, const PlaneCosts&, float step, int begin, int end, float* inverse_depth, float* confidence);
  int64_t (*multiply_adds)(int64_t rounds, float* out);

  template <class T>
  const KernelsOf<T>& of() const {
    if constexpr (sizeof(T) == sizeof(float))
      return of_float;
    else
      return of_double;
  }
};

// Returns the kernels for the best instruction set that this machine supports, or for the one that GLOBALSPLAT_SIMD names. Throws
// std::invalid_argument if it names one that this machine or build doesn't support.
const Kernels& kernels();

}  // namespace globalsplat::raster
