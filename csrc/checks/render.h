// Renders of scenes by the CPU backend, forward and backward, with all of their inputs and outputs; and how checks report an error.
#pragma once

#include <iterator>
#include <memory>
#include <string>
#include <vector>

#include "scenes.h"

namespace globalsplat::checks {

// Names what is checked from now on. If it takes longer than two minutes, the program ends with an error.
void begin(std::string what);
// Ends the program with an error.
[[noreturn]] void fail(const std::string& what);
template <class Text>
void expect(bool holds, const Text& what) {
  if (!holds) fail(what);
}

// Checks that the GPU kernels, in the emulation on a CPU, give the same results in other orders of blocks and threads, and those of the CPU
// backend.
int64_t orders(bool is_short);

// Names of a render's results: images, and gradients of random gradients of these.
inline constexpr const char* kResults[] = {"colors", "opacities", "depths", "gradients of means", "gradients of scales",
                                           "gradients of quaternions", "gradients of opacities", "gradients of harmonics",
                                           "gradients of projected means", "gradients of cameras"};
inline constexpr size_t kImages = 3;  // number of images, the first results

// Results by their index in kResults, each for all scenes and views consecutively.
template <class T>
using Results = std::vector<std::vector<T>>;

template <class T>
raster::RenderOutput<const T> pictures(const Results<T>& of) {
  return {of[0].data(), of[1].data(), of[2].data()};
}
template <class T>
raster::GaussianGradients<T> gradients(Results<T>& of) {
  return {of[3].data(), of[4].data(), of[5].data(), of[6].data(), of[7].data(), of[8].data()};
}

// A render, to be drawn and differentiated.
template <class T>
class Render {
 public:
  Render(const Scene<T>& scene, int num_threads) : scene_(&scene), num_threads_(num_threads) {
    const size_t views = size_t(scene.batch * scene.cameras), pixels = size_t(scene.width) * size_t(scene.height) * views;
    const size_t splats = size_t(scene.cameras) * scene.opacities.size();
    for (const size_t size : {3 * pixels, pixels, pixels, scene.means.size(), scene.scales.size(), scene.quaternions.size(),
                              scene.opacities.size(), scene.sh.size(), 2 * splats, scene.w2c.size()})
      results_.emplace_back(size, T(num_threads));  // unwritten outputs differ from those of a render with another number of threads
    Random random(9);
    for (size_t k = 0; k < kImages; ++k) output_gradients_.push_back(converted<T>(random.uniform(results_[k].size(), -1, 1)));
  }

  void draw() {
    raster::StageTimes times;
    const raster::RenderOutput<T> out{results_[0].data(), results_[1].data(), results_[2].data()};
    frame_ = std::make_unique<raster::Frame<T>>(scene_->arguments(), num_threads_, out, times);
  }

  void backward() {
    raster::StageTimes times;
    frame_->backward(scene_->arguments(), pictures(results_), pictures(output_gradients_), gradients(results_), results_[9].data(), times);
  }

  void drop() { frame_.reset(); }

  const Results<T>& results() const { return results_; }
  const Results<T>& output_gradients() const { return output_gradients_; }

 private:
  const Scene<T>* scene_;
  int num_threads_;
  Results<T> results_, output_gradients_;
  std::unique_ptr<raster::Frame<T>> frame_;
};

// Renders a scene, forward and backward.
template <class T>
Results<T> rendered(const Scene<T>& scene, int num_threads) {
  Render<T> render(scene, num_threads);
  render.draw();
  render.backward();
  return render.results();
}

}  // namespace globalsplat::checks
