// The rasterizer: many scenes, several cameras each, in one call; forward, and backward from what the forward kept.
#pragma once

#include <memory>
#include <vector>

#include "bins.h"
#include "types.h"

namespace globalsplat::raster {

template <class T>
struct View {
  Camera<T> camera;
  int scene;  // which of the scenes it looks at
};

struct Settings {
  int width, height;
  double eps2d;  // added to the diagonal of every 2D covariance, pixels²
  int threads;
};

// Wall-clock seconds that the stages of one call took, all views together.
struct StageTimes {
  double project = 0, sort = 0, bin = 0, blend = 0;
  double blend_backward = 0, project_backward = 0;
};

// What a forward pass leaves for its backward pass: per view the splats and the tile lists.
template <class T>
class Frame {
 public:
  // Draws every view into its pictures: `out[k]` for `views[k]`. All scenes have the same number of Gaussians; a scene's
  // views follow each other.
  static std::unique_ptr<Frame> draw(const std::vector<Gaussians<T>>& scenes, const std::vector<View<T>>& views,
                                     const Settings& settings, const std::vector<Pictures<T>>& out,
                                     StageTimes& times);

  // `scenes` and `pictures` are draw()'s inputs and outputs, unchanged. Writes every gradient of every Gaussian, and of every
  // view's camera into `cameras`, which is null where nobody asks. Sums run over a scene's cameras, a camera's tiles and, in
  // tasks, its Gaussians in order, so the bits don't depend on the number of threads.
  void backward(const std::vector<Gaussians<T>>& scenes, const std::vector<Pictures<const T>>& pictures,
                const std::vector<Pictures<const T>>& gradients, const std::vector<GaussianGradients<T>>& out,
                CameraGradient<T>* cameras, StageTimes& times) const;

  // What blending all views takes, for benchmarks.
  PairCounts count() const;

  ~Frame();

 private:
  struct PerView;
  struct Part;
  Frame(const std::vector<View<T>>& views, const std::vector<Gaussians<T>>& scenes, const Settings& settings);
  std::vector<Part> project(const std::vector<Gaussians<T>>& scenes);
  void cover(PerView& view, int64_t begin, int64_t end, Part& part) const;
  std::vector<Buffer<DepthItem<T>>> sort(const std::vector<Part>& made);
  void bin(const std::vector<Part>& made, const std::vector<Buffer<DepthItem<T>>>& order);
  int64_t chunks() const;
  TileJob<T> job(const PerView& view, int tile) const;

  Settings settings_;
  Grid grid_;
  int64_t count_;  // Gaussians of a scene
  int64_t tasks_;  // in which a scene's Gaussians are taken
  std::vector<PerView> views_;
  std::vector<Lens<T>> lenses_;
  std::vector<size_t> first_view_;  // [scenes + 1] of a scene
};

// Floating-point operations per second that multiply-adds alone reach on so many threads, for benchmarks.
double multiply_add_peak(int threads, double seconds);

}  // namespace globalsplat::raster
