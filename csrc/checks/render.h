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
class Render {
 public:
  Render(const Scene<T>& scene, int num_threads)
      : settings_{scene.width, scene.height, scene.projection, num_threads}, views_(scene.views) {
    // Unwritten outputs differ from those of a render with another number of threads.
    const T unwritten = T(num_threads);
    const size_t pixels = size_t(scene.width) * size_t(scene.height);
    for (const Arrays<T>& g : scene.gaussians) {
      scenes_.push_back({g.means.data(), g.scales.data(), g.quaternions.data(), g.opacities.data(), g.sh.data(),
                         int64_t(g.opacities.size()), scene.bases});
      gradients_.push_back(g);
      Arrays<T>& d = gradients_.back();
      for (auto* array : {&d.means, &d.scales, &d.quaternions, &d.opacities, &d.sh}) std::fill(array->begin(), array->end(), unwritten);
      means2d_.emplace_back(2 * g.opacities.size() * views_.size() / scene.gaussians.size(), unwritten);
    }
    Random random(9);
    for (size_t k = 0; k < views_.size(); ++k) {
      pictures_.push_back({std::vector<T>(3 * pixels, unwritten), std::vector<T>(pixels, unwritten),
                           std::vector<T>(pixels, unwritten)});
      output_gradients_.push_back(pictures_.back());
      for (auto& plane : output_gradients_.back())
        for (T& value : plane) value = T(random.uniform(-1, 1));
    }
  }

  void draw() {
    raster::StageTimes times;
    frame_ = raster::Frame<T>::draw(scenes_, views_, settings_, places<T>(pictures_), times);
  }

  void backward() {
    std::vector<raster::GaussianGradients<T>> out;
    for (size_t b = 0; b < gradients_.size(); ++b) {
      Arrays<T>& g = gradients_[b];
      out.push_back({g.means.data(), g.scales.data(), g.quaternions.data(), g.opacities.data(), g.sh.data(), means2d_[b].data()});
    }
    raster::StageTimes times;
    cameras_.assign(views_.size(), {});
    frame_->backward(scenes_, places<const T>(pictures_), places<const T>(output_gradients_), out, cameras_.data(), times);
  }

  void drop() { frame_.reset(); }

  Results<T> results() const {
    Results<T> all(std::size(kResults));
    const auto append = [&](size_t result, const std::vector<T>& more) {
      all[result].insert(all[result].end(), more.begin(), more.end());
    };
    for (const Planes& planes : pictures_)
      for (size_t k = 0; k < kImages; ++k) append(k, planes[k]);
    for (size_t b = 0; b < gradients_.size(); ++b) {
      const Arrays<T>& d = gradients_[b];
      size_t result = kImages;
      for (const auto* array : {&d.means, &d.scales, &d.quaternions, &d.opacities, &d.sh, &means2d_[b]}) append(result++, *array);
    }
    for (const raster::CameraGradient<T>& camera : cameras_) {
      const T* d = camera.numbers;  // as 4×4 matrix
      append(9, {d[0], d[1], d[2], d[9], d[3], d[4], d[5], d[10], d[6], d[7], d[8], d[11], 0, 0, 0, 0});
    }
    return all;
  }

  // Returns the gradients with respect to the images.
  Results<T> output_gradients() const {
    Results<T> all(kImages);
    for (const Planes& planes : output_gradients_)
      for (size_t k = 0; k < kImages; ++k) all[k].insert(all[k].end(), planes[k].begin(), planes[k].end());
    return all;
  }

 private:
  using Planes = std::array<std::vector<T>, kImages>;

  template <class Pixel, class AllPlanes>
  static std::vector<raster::RenderOutput<Pixel>> places(AllPlanes& of) {
    std::vector<raster::RenderOutput<Pixel>> out;
    for (auto& [rgb, alpha, depth] : of) out.push_back({rgb.data(), alpha.data(), depth.data()});
    return out;
  }

  raster::Settings settings_;
  std::vector<raster::Gaussians<T>> scenes_;
  std::vector<raster::View<T>> views_;
  std::vector<Planes> pictures_, output_gradients_;  // one item per view
  std::vector<raster::CameraGradient<T>> cameras_;
  std::vector<Arrays<T>> gradients_;
  std::vector<std::vector<T>> means2d_;  // gradients of projected means, one item per scene
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
