// The rasterizer: many scenes with several cameras each in one call; a forward pass, and a backward pass that uses state of the forward
// pass.
#pragma once

#include <vector>

#include "counting_sort.h"
#include "types.h"

namespace globalsplat::raster {

// Wall-clock seconds of the stages of one call, summed over all views.
struct StageTimes {
  double project = 0, sort = 0, bin = 0, blend = 0;
  double blend_backward = 0, project_backward = 0;
};

// State of a forward pass for its backward pass: the splats and the tile lists of each view.
template <class T>
class Frame {
 public:
  // Renders every view, on several threads.
  Frame(const Arguments<T>& in, int num_threads, const RenderOutput<T>& out, StageTimes& times);

  // Computes every gradient of every Gaussian, and of w2c, [B, C, 4, 4], if that isn't null. `in` and `pictures` are the unchanged inputs and
  // outputs of the forward pass. Sums run in order over a scene's cameras, a camera's tiles and, by tasks, its Gaussians, so results are
  // bit-identical for any number of threads.
  void backward(const Arguments<T>& in, const RenderOutput<const T>& pictures, const RenderOutput<const T>& gradients,
                const GaussianGradients<T>& out, T* w2c, StageTimes& times) const;

  // Counts the pairs that blending all views processes, for benchmarks.
  PairCounts count_pairs() const;

  ~Frame();

 private:
  struct PerView;
  struct TaskOutput;
  std::vector<TaskOutput> project(const Arguments<T>& in);
  void list_touched_tiles(PerView& view, int64_t begin, int64_t end, TaskOutput& part) const;
  std::vector<Buffer<DepthItem<T>>> sort(const std::vector<TaskOutput>& task_outputs);
  void bin(const std::vector<TaskOutput>& task_outputs, const std::vector<Buffer<DepthItem<T>>>& order);
  int64_t chunks() const;
  TileJob<T> job(const PerView& view, int tile) const;

  int num_threads_;
  Grid grid_;
  int64_t count_;  // Gaussians per scene
  int64_t tasks_;  // into which a scene's Gaussians are split
  std::vector<PerView> views_;
  std::vector<ProjectionParams<T>> projection_params_;
};

}  // namespace globalsplat::raster
