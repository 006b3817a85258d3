#include "jobs.h"

#include <algorithm>

#include "counting_sort.h"
#include "kernels.h"
#include "parallel.h"

namespace globalsplat::raster {

namespace {

constexpr int kPlanes = 8;  // planes of a task
constexpr int kRows = 8;    // rows of a task

// Returns the scores of all planes, [planes, H, sweep_stride(W)].
Buffer<float> score_planes(const PlaneSweep& sweep, int planes, int num_threads) {
  const int64_t plane = sweep_stride(sweep.own.width) * sweep.own.height;
  Buffer<float> scores(size_t(planes * plane));
  parallel_for(num_threads, (planes + kPlanes - 1) / kPlanes, [&](int64_t task) {
    const int begin = int(task) * kPlanes, end = std::min(begin + kPlanes, planes);
    kernels().sweep_planes(sweep, begin, end, scores.data.get() + begin * plane, scratch(sweep_scratch_size(sweep)));
  });
  return scores;
}

// Calls rows(begin, end) for all rows of a photo, in parallel.
template <class Rows>
void for_rows(int num_threads, int height, const Rows& rows) {
  parallel_for(num_threads, (height + kRows - 1) / kRows, [&](int64_t task) {
    const int begin = int(task) * kRows;
    rows(begin, std::min(begin + kRows, height));
  });
}

}  // namespace

void search_depths(const PlaneSweep& sweep, int planes, float* inverse_depth, float* score, int num_threads) {
  const int width = sweep.own.width, height = sweep.own.height;
  const int64_t stride = sweep_stride(width), plane = stride * height;
  const Buffer<float> scores = score_planes(sweep, planes, num_threads);
  for_rows(num_threads, height, [&](int begin, int end) {
    for (int row = begin; row < end; ++row) {
      float *const best = score + int64_t(row) * width, *const best_plane = inverse_depth + int64_t(row) * width;
      std::fill_n(best, width, -2.0f);
      // The first of equal planes counts.
      for (int d = 0; d < planes; ++d) {
        const float* const here = scores.data.get() + d * plane + row * stride;
        const float depth = float(d) * sweep.step;
        for (int i = 0; i < width; ++i) {
          best_plane[i] = here[i] > best[i] ? depth : best_plane[i];
          best[i] = here[i] > best[i] ? here[i] : best[i];
        }
      }
    }
  });
}

void match_semi_globally(const PlaneSweep& sweep, int planes, float* inverse_depth, float* confidence, int num_threads) {
  const SweepPhoto& own = sweep.own;
  const Buffer<float> variance(size_t(sweep_stride(own.width) * own.height));
  kernels().patch_variances(own, sweep.least_variance, variance.data.get(), scratch(variance_scratch_size(own)));
  const MatchedPhoto photo{own.gray, variance.data.get(), sweep.least_variance, own.width, own.height, planes};
  const size_t size = size_t(int64_t(own.width) * own.height * plane_stride(planes));
  const Buffer<float> own_costs(size), forward(size), backward(size);
  const PlaneCosts costs{own_costs.data.get(), forward.data.get(), backward.data.get()};
  const Buffer<float> scores = score_planes(sweep, planes, num_threads);
  for_rows(num_threads, own.height, [&](int begin, int end) {
    kernels().costs_of_rows(photo, scores.data.get(), begin, end, costs.own);
  });
  parallel_for(num_threads, 2, [&](int64_t task) {
    kernels().sum_paths(photo, costs.own, task == 1, task == 0 ? costs.forward : costs.backward, scratch(path_scratch_size(photo)));
  });
  for_rows(num_threads, own.height, [&](int begin, int end) {
    kernels().choose_planes(photo, costs, sweep.step, begin, end, inverse_depth, confidence);
  });
}

}  // namespace globalsplat::raster
