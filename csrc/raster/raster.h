// The rasterizer: many scenes, several cameras each, in one call; forward, and backward from what the forward kept.
#pragma once

#include <memory>
#include <vector>

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

// What a forward pass leaves for its backward pass: per view the visible splats front to back and the tile lists.
template <class T>
class Frame {
 public:
  // Draws every view into its pictures: `out[k]` for `views[k]`.
  static std::unique_ptr<Frame> draw(const std::vector<Gaussians<T>>& scenes, const std::vector<View<T>>& views,
                                     const Settings& settings, const std::vector<Pictures<T>>& out,
                                     StageTimes& times);

  // `scenes` and `pictures` are draw()'s inputs and outputs, unchanged. Writes every gradient of every Gaussian; sums
  // run over a scene's cameras and a camera's tiles in order, so the bits don't depend on the number of threads.
  void backward(const std::vector<Gaussians<T>>& scenes, const std::vector<Pictures<const T>>& pictures,
                const std::vector<Pictures<const T>>& gradients, const std::vector<GaussianGradients<T>>& out, StageTimes& times) const;

  ~Frame();

 private:
  struct PerView;
  Frame(const std::vector<View<T>>& views, const Settings& settings);
  TileJob<T> job(const PerView& view, int tile) const;

  Settings settings_;
  int tiles_x_, tiles_y_;
  std::vector<PerView> views_;
};

}  // namespace globalsplat::raster
