// The shape of all checks: something is computed several times, with other numbers of threads or in other orders, and every result must
// have the same bits. Also renders of scenes by the CPU backend, with all of their inputs and outputs.
#pragma once

#include <array>
#include <cstring>
#include <memory>
#include <string>
#include <vector>

#include "../kernels/jobs.h"
#include "scenes.h"

namespace globalsplat::checks {

// Names what is checked from now on. If it takes longer than two minutes, the program ends with an error.
void begin(std::string what);
// Ends the program with an error, unless `holds`.
void expect(bool holds, const char* what);

// Results by their index, each for all scenes and views consecutively.
template <class T>
using Results = std::vector<std::vector<T>>;

template <class T>
void expect_same(const Results<T>& found, const Results<T>& first) {
  for (size_t k = 0; k < first.size(); ++k) {
    const size_t bytes = first[k].size() * sizeof(T);
    const bool is_same = found[k].size() == first[k].size() && (bytes == 0 || std::memcmp(found[k].data(), first[k].data(), bytes) == 0);
    expect(is_same, ("result " + std::to_string(k) + " differs from the first run's").c_str());
  }
}

// Checks that run(variant) returns the same bits for each of `variants`, which are numbers of threads or seeds of orders. Returns the
// number of runs.
template <class Run>
int64_t check_same_bits(const std::string& name, const std::vector<int>& variants, const Run& run) {
  begin(name + ", " + std::to_string(variants[0]));
  const auto first = run(variants[0]);
  for (size_t n = 1; n < variants.size(); ++n) {
    begin(name + ", " + std::to_string(variants[n]));
    expect_same(run(variants[n]), first);
  }
  return int64_t(variants.size());
}

// Checks losses of images of edge sizes, and their gradients. photometric(variant, job, l1_weight, ssim_weight, gradient) and
// smoothness(variant, job, gradient) return a loss, and write its gradient unless it is null. Returns the number of runs.
template <class T, class Photometric, class Smoothness>
int64_t check_losses(const std::vector<int>& variants, const Photometric& photometric, const Smoothness& smoothness) {
  Random random(11);
  const auto numbers = [&](size_t size) { return converted<T>(random.uniform(size, 0, 1)); };
  int64_t count = 0;
  for (const auto& [planes, height, width] : {std::array<int, 3>{1, 11, 11}, {2, 43, 48}, {3, 12, 75}, {1, 1, 1}, {2, 17, 1}}) {
    const size_t size = size_t(planes * height * width);
    std::vector<T> images = numbers(size);
    for (size_t k = 0; k < size; k += 7) images[k] = 0;
    const std::vector<T> photos = numbers(size), color_photos = numbers(3 * size);
    const raster::LossJob<T> job{images.data(), photos.data(), planes, width, height};
    const raster::LossJob<T> depth_job{images.data(), color_photos.data(), planes, width, height};
    const auto check = [&](const char* name, const auto& loss) {
      count += check_same_bits(name, variants, [&](int variant) {
        std::vector<T> gradient(size, T(variant));
        const double value = loss(variant, gradient.data());
        expect(loss(variant, nullptr) == value, "the gradient changes the value");
        return Results<double>{{value}, {gradient.begin(), gradient.end()}};
      });
    };
    for (const auto& [l1_weight, ssim_weight] : {std::array<double, 2>{0.8, 0}, {0, 1}, {0.8, -0.2}})
      if (height >= 11 && width >= 11)  // the window of SSIM
        check("the photometric loss", [&, a = l1_weight, s = ssim_weight](int variant, T* gradient) {
          return photometric(variant, job, a, s, gradient);
        });
    check("smoothness", [&](int variant, T* gradient) { return smoothness(variant, depth_job, gradient); });
  }
  return count;
}

// Calls check(scene) for all scenes with each number of bases; in the short form, for each with one of these numbers. Returns the sum.
template <class Check>
int64_t for_all_scenes(bool is_short, const Check& check) {
  int64_t sum = 0;
  size_t turn = 0;
  for (const int bases : {1, 4, 9, 16}) {
    const std::vector<Scene<double>> scenes = all_scenes(bases);
    for (size_t i = 0; i < scenes.size(); ++i)
      if (!is_short || i % 4 == turn) sum += check(scenes[i]);
    ++turn;
  }
  return sum;
}

// A render, to be drawn and differentiated. Its results are three images, the gradients of the Gaussians and of their projected means,
// and those of the cameras, from random gradients of the images.
template <class T>
struct Render {
  Render(const Scene<T>& scene, int num_threads) : scene(&scene), num_threads(num_threads) {
    const size_t views = size_t(scene.batch * scene.cameras), pixels = size_t(scene.width) * size_t(scene.height) * views;
    const size_t splats = size_t(scene.cameras) * scene.opacities.size();
    for (const size_t size : {3 * pixels, pixels, pixels, scene.means.size(), scene.scales.size(), scene.quaternions.size(),
                              scene.opacities.size(), scene.sh.size(), 2 * splats, scene.w2c.size()})
      results.emplace_back(size, T(num_threads));  // unwritten outputs differ from those of a render with another number of threads
    Random random(9);
    for (size_t k = 0; k < 3; ++k) output_gradients.push_back(converted<T>(random.uniform(results[k].size(), -1, 1)));
  }

  raster::RenderOutput<T> images() { return {results[0].data(), results[1].data(), results[2].data()}; }
  raster::RenderOutput<const T> drawn_images() const { return {results[0].data(), results[1].data(), results[2].data()}; }
  raster::RenderOutput<const T> image_gradients() const {
    return {output_gradients[0].data(), output_gradients[1].data(), output_gradients[2].data()};
  }
  raster::GaussianGradients<T> gradients() {
    return {results[3].data(), results[4].data(), results[5].data(), results[6].data(), results[7].data(), results[8].data()};
  }

  void draw() {
    raster::StageTimes times;
    frame = std::make_unique<raster::Frame<T>>(scene->arguments(), num_threads, images(), times);
  }
  void backward() {
    raster::StageTimes times;
    frame->backward(scene->arguments(), drawn_images(), image_gradients(), gradients(), results[9].data(), times);
  }

  const Scene<T>* scene;
  int num_threads;
  Results<T> results, output_gradients;
  std::unique_ptr<raster::Frame<T>> frame;
};

// Renders a scene, forward and backward.
template <class T>
Results<T> rendered(const Scene<T>& scene, int num_threads) {
  Render<T> render(scene, num_threads);
  render.draw();
  render.backward();
  return render.results;
}

// Checks that the GPU kernels, in the emulation on a CPU, give the same results in other orders of blocks and threads, and the images of
// the CPU backend.
int64_t check_orders(bool is_short);

}  // namespace globalsplat::checks
