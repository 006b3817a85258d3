#include "depth_search.h"

#include <algorithm>

#include "counting_sort.h"
#include "kernels.h"
#include "parallel.h"

namespace globalsplat::raster {

constexpr int kPlanes = 8;  // planes of a task

void search_depths(const PlaneSweep& sweep, int planes, float* inverse_depth, float* score, int num_threads) {
  const int width = sweep.own.width, height = sweep.own.height;
  const int64_t stride = sweep_stride(width), plane = stride * height;
  const int64_t tasks = (planes + kPlanes - 1) / kPlanes;
  const Buffer<float> found(size_t(2 * plane * tasks));
  const auto best_of = [&](int64_t task) {
    float* const own = found.data.get() + 2 * plane * task;
    return BestPlanes{own, own + plane};
  };
  parallel_for(num_threads, tasks, [&](int64_t task) {
    const int begin = int(task) * kPlanes;
    kernels().sweep_planes(sweep, begin, std::min(begin + kPlanes, planes), best_of(task), scratch(sweep_scratch_size(sweep)));
  });
  for (int64_t row = 0; row < height; ++row)
    for (int64_t column = 0; column < width; ++column) {
      const int64_t from = row * stride + column, to = row * width + column;
      score[to] = -2;
      for (int64_t task = 0; task < tasks; ++task) {
        const BestPlanes best = best_of(task);
        if (best.correlation[from] <= score[to]) continue;
        score[to] = best.correlation[from];
        inverse_depth[to] = best.plane[from] * sweep.step;
      }
    }
}

}  // namespace globalsplat::raster
