// The rasterizer: many scenes with several cameras each in one call; a forward pass, and a backward pass that uses state of the forward
// pass.
#pragma once

#include <memory>
#include <vector>

#include "counting_sort.h"
#include "types.h"

namespace globalsplat::raster {

template <class T>
struct View {
  Camera<T> camera;
  int scene;  // index of the scene
};

struct Settings {
  int width, height;
  ProjectionSettings projection;
  int num_threads;
};

// Wall-clock seconds of the stages of one call, summed over all views.
struct StageTimes {
  double project = 0, sort = 0, bin = 0, blend = 0;
  double blend_backward = 0, project_backward = 0;
};

// State of a forward pass for its backward pass: the splats and the tile lists of each view.
template <class T>
class Frame {
 public:
  // Renders every view into its images: `out[k]` for `views[k]`. All scenes must have the same number of Gaussians, and a scene's views
  // must be consecutive.
  static std::unique_ptr<Frame> draw(const std::vector<Gaussians<T>>& scenes, const std::vector<View<T>>& views,
                                     const Settings& settings, const std::vector<RenderOutput<T>>& out,
                                     StageTimes& times);

  // Computes every gradient of every Gaussian, and of every view's camera if `cameras` isn't null. `scenes` and `pictures` are the
  // unchanged inputs and outputs of draw(). Sums run in order over a scene's cameras, a camera's tiles and, by tasks, its Gaussians, so
  // results are bit-identical for any number of threads.
  void backward(const std::vector<Gaussians<T>>& scenes, const std::vector<RenderOutput<const T>>& pictures,
                const std::vector<RenderOutput<const T>>& gradients, const std::vector<GaussianGradients<T>>& out,
                CameraGradient<T>* cameras, StageTimes& times) const;

  // Counts the pairs that blending all views processes, for benchmarks.
  PairCounts count_pairs() const;

  ~Frame();

 private:
  struct PerView;
  struct TaskOutput;
  Frame(const std::vector<View<T>>& views, const std::vector<Gaussians<T>>& scenes, const Settings& settings);
  std::vector<TaskOutput> project(const std::vector<Gaussians<T>>& scenes);
  void list_touched_tiles(PerView& view, int64_t begin, int64_t end, TaskOutput& part) const;
  std::vector<Buffer<DepthItem<T>>> sort(const std::vector<TaskOutput>& task_outputs);
  void bin(const std::vector<TaskOutput>& task_outputs, const std::vector<Buffer<DepthItem<T>>>& order);
  int64_t chunks() const;
  TileJob<T> job(const PerView& view, int tile) const;

  Settings settings_;
  Grid grid_;
  int64_t count_;  // Gaussians per scene
  int64_t tasks_;  // into which a scene's Gaussians are split
  std::vector<PerView> views_;
  std::vector<ProjectionParams<T>> projection_params_;
  std::vector<size_t> first_view_;  // [scenes + 1] first view of each scene
};

}  // namespace globalsplat::raster
