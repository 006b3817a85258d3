#include "scenes.h"

#include <array>
#include <cmath>
#include <cstdio>
#include <cstring>

#include "../cuda/device.h"
#include "../cuda/frame.h"
#include "../kernels/kernels.h"

namespace globalsplat::checks {
namespace {

using Numbers = std::vector<float>;

// Outputs and gradients of a render, for all scenes and views consecutively.
struct RenderResult {
  Numbers rgb, alpha, depth, means, scales, quaternions, opacities, sh, w2c, means2d;
  std::vector<Numbers*> all() {
    return {&rgb, &alpha, &depth, &means, &scales, &quaternions, &opacities, &sh, &w2c, &means2d};
  }
  static constexpr size_t kImages = 3;  // number of images, the first items of all()
};

void append(Numbers& to, const Numbers& more) { to.insert(to.end(), more.begin(), more.end()); }

// Returns random gradients with respect to images.
Numbers random_gradients(Random& random, size_t count) { return converted<float>(random.uniform(count, -1, 1)); }

// Returns the number of Gaussians per scene.
size_t count_of(const Scene<float>& scene) { return scene.gaussians.empty() ? 0 : scene.gaussians[0].opacities.size(); }

// Returns a result of the scene's sizes, filled with NaN.
RenderResult nan_filled(const Scene<float>& scene) {
  const size_t pixels = size_t(scene.width) * size_t(scene.height) * scene.views.size();
  const size_t count = count_of(scene) * scene.gaussians.size();
  const auto nans = [](size_t numbers) { return Numbers(numbers, std::nanf("")); };
  return {nans(3 * pixels), nans(pixels), nans(pixels), nans(3 * count), nans(3 * count), nans(4 * count),
          nans(count), nans(size_t(scene.bases) * 3 * count), nans(16 * scene.views.size()),
          nans(2 * count_of(scene) * scene.views.size())};
}

// Renders with the GPU kernels in the emulator, forward and backward. `seed` determines the order of blocks and threads.
RenderResult render_emulated(const Scene<float>& scene, uint64_t seed) {
  Numbers means, scales, quaternions, opacities, sh, w2c, intrinsics;
  for (const Arrays<float>& g : scene.gaussians) {
    append(means, g.means);
    append(scales, g.scales);
    append(quaternions, g.quaternions);
    append(opacities, g.opacities);
    append(sh, g.sh);
  }
  for (const raster::View<float>& view : scene.views) {
    const raster::Camera<float>& c = view.camera;
    for (int row = 0; row < 3; ++row) {
      w2c.insert(w2c.end(), c.rotation + 3 * row, c.rotation + 3 * row + 3);
      w2c.push_back(c.translation[row]);
    }
    append(w2c, {0, 0, 0, 1});
    append(intrinsics, {c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1});
  }
  Random random(9);
  const size_t pixels = size_t(scene.width) * size_t(scene.height) * scene.views.size();
  const Numbers g_rgb = random_gradients(random, 3 * pixels), g_alpha = random_gradients(random, pixels);
  const Numbers g_depth = random_gradients(random, pixels);

  const int64_t scenes = int64_t(scene.gaussians.size());
  const cuda::Arguments arguments{{means.data(), scales.data(), quaternions.data(), opacities.data(), sh.data(),
                                   int64_t(count_of(scene)), scene.bases},
                                  w2c.data(), intrinsics.data(), scenes,
                                  scenes == 0 ? 0 : int64_t(scene.views.size()) / scenes, scene.width, scene.height,
                                  scene.projection};
  RenderResult result = nan_filled(scene);
  const cuda::emulated::Emulator device(seed);
  const cuda::Frame frame(device, arguments, {result.rgb.data(), result.alpha.data(), result.depth.data()});
  frame.backward(device, arguments, {result.rgb.data(), result.alpha.data(), result.depth.data()},
                 {g_rgb.data(), g_alpha.data(), g_depth.data()},
                 {result.means.data(), result.scales.data(), result.quaternions.data(), result.opacities.data(), result.sh.data(),
                  result.means2d.data()},
                 result.w2c.data());
  return result;
}

// Renders with the CPU backend, forward and backward.
RenderResult render_on_cpu(const Scene<float>& scene) {
  const size_t pixels = size_t(scene.width) * size_t(scene.height), views = scene.views.size(), count = count_of(scene);
  Random random(9);
  const Numbers g_rgb = random_gradients(random, 3 * pixels * views), g_alpha = random_gradients(random, pixels * views);
  const Numbers g_depth = random_gradients(random, pixels * views);
  RenderResult result = nan_filled(scene);
  std::vector<raster::Gaussians<float>> gaussians;
  std::vector<raster::GaussianGradients<float>> out;
  for (size_t b = 0; b < scene.gaussians.size(); ++b) {
    const Arrays<float>& g = scene.gaussians[b];
    gaussians.push_back({g.means.data(), g.scales.data(), g.quaternions.data(), g.opacities.data(), g.sh.data(), int64_t(count),
                         scene.bases});
    out.push_back({result.means.data() + 3 * count * b, result.scales.data() + 3 * count * b, result.quaternions.data() + 4 * count * b,
                   result.opacities.data() + count * b, result.sh.data() + size_t(scene.bases) * 3 * count * b,
                   result.means2d.data() + 2 * count * views / scene.gaussians.size() * b});
  }
  std::vector<raster::RenderOutput<float>> outputs;
  std::vector<raster::RenderOutput<const float>> pictures, gradients;
  for (size_t k = 0; k < views; ++k) {
    outputs.push_back({result.rgb.data() + 3 * pixels * k, result.alpha.data() + pixels * k, result.depth.data() + pixels * k});
    pictures.push_back({outputs[k].rgb, outputs[k].alpha, outputs[k].depth});
    gradients.push_back({g_rgb.data() + 3 * pixels * k, g_alpha.data() + pixels * k, g_depth.data() + pixels * k});
  }
  raster::StageTimes times;
  std::vector<raster::CameraGradient<float>> cameras(views);
  const raster::Settings settings{scene.width, scene.height, scene.projection, 2};
  const auto frame = raster::Frame<float>::draw(gaussians, scene.views, settings, outputs, times);
  frame->backward(gaussians, pictures, gradients, out, cameras.data(), times);
  for (size_t k = 0; k < views; ++k)
    for (int number = 0; number < 16; ++number) {
      const int row = number / 4, column = number % 4;
      result.w2c[16 * k + size_t(number)] =
          row == 3 ? 0 : cameras[k].numbers[column < 3 ? 3 * row + column : 9 + row];
    }
  return result;
}

double max_abs(const Numbers& numbers) {
  double max = 0;
  for (const float number : numbers) max = std::max(max, std::abs(double(number)));
  return max;
}

double max_abs_difference(const Numbers& a, const Numbers& b) {
  double max = 0;
  for (size_t k = 0; k < a.size(); ++k) max = std::max(max, std::abs(double(a[k]) - double(b[k])));
  return max;
}

}  // namespace

std::string schedules_differ(const Scene<float>& scene, const std::vector<uint64_t>& seeds) {
  const char* const names[] = {"colors", "opacities", "depths", "means", "scales", "quaternions", "opacities' gradients",
                               "spherical harmonics", "cameras"};
  RenderResult cpu = render_on_cpu(scene), first = render_emulated(scene, seeds[0]);
  // Infinite values and NaN spread to other pixels: of a block on the CPU, of two blocks in the kernels. These scenes aren't compared.
  const bool has_special_values = scene.name.rfind("special", 0) == 0;
  double max_gradient = 0;
  for (size_t k = RenderResult::kImages; k < cpu.all().size(); ++k) max_gradient = std::max(max_gradient, max_abs(*cpu.all()[k]));
  for (size_t k = 0; k < first.all().size() && !has_special_values; ++k) {
    const Numbers &ours = *first.all()[k], &theirs = *cpu.all()[k];
    // Some gradients, such as that of a sphere's rotation, are differences of larger values that cancel. So the tolerance also depends on
    // the largest of all gradients.
    const double error = max_abs_difference(ours, theirs);
    const double tolerance = k < RenderResult::kImages ? 0 : 1e-3 * max_abs(theirs) + 1e-5 * max_gradient;
    if (!(error <= tolerance)) return std::string(names[k]) + " differ from the CPU's by " + std::to_string(error);
  }
  for (size_t n = 1; n < seeds.size(); ++n) {
    RenderResult other = render_emulated(scene, seeds[n]);
    for (size_t k = 0; k < first.all().size(); ++k)
      if (!have_same_bits(*first.all()[k], *other.all()[k]))
        return std::string(names[k]) + " change with the order of threads, seed " + std::to_string(seeds[n]);
  }
  return {};
}

std::string sums_differ(uint64_t seed) {
  const size_t lengths[2] = {5000, 1500};
  Random random(seed);
  std::vector<uint32_t> counts[2], sums[2], expected[2];
  uint64_t total = 0, totals[2] = {};
  for (int row = 0; row < 2; ++row) {
    for (const double value : random.uniform(lengths[row], 0, 100)) counts[row].push_back(uint32_t(value));
    for (const uint32_t count : counts[row]) {
      expected[row].push_back(uint32_t(totals[row]));
      totals[row] += count;
    }
    sums[row].resize(lengths[row]);
  }
  using cuda::gs_scan;
  const auto row_of = [&](int row) { return cuda::Counts{int64_t(lengths[row]), counts[row].data(), sums[row].data()}; };
  GS_LAUNCH(cuda::emulated::Emulator(seed), gs_scan, (cuda::Blocks{3, 2}), cuda::kScanThreads, row_of(0), row_of(1), &total);
  return sums[0] == expected[0] && sums[1] == expected[1] && total == totals[0] ? "" : "prefix sums differ";
}

std::string losses_differ(const std::vector<uint64_t>& seeds) {
  Random random(12);
  const auto numbers = [&](size_t count) { return converted<float>(random.uniform(count, 0, 1)); };
  const auto sum_of = [](const cuda::PartialSums& parts) {
    double sum = 0;
    for (int64_t k = 0; k < parts.count; ++k) sum += static_cast<const double*>(parts.numbers.get())[k];
    return sum;
  };
  // The CPU computes the same gradients as the kernels, bit for bit, unless its instruction set lacks fused multiply-add.
  const bool is_fused = std::strcmp(raster::kernels().name, "portable") != 0;
  // Compares a loss and its gradient of `size` values. cpu_loss(gradient) returns the loss, and device_loss(device, gradient) its terms;
  // both write the gradient unless it is null.
  const auto difference = [&](size_t size, const auto& cpu_loss, const auto& device_loss) -> std::string {
    Numbers cpu(size), first;
    const double expected = cpu_loss(cpu.data());
    double value = 0;
    for (const uint64_t seed : seeds) {
      const cuda::emulated::Emulator device(seed);
      Numbers gradient(size, std::nanf(""));
      const double found = sum_of(device_loss(device, gradient.data()));
      if (sum_of(device_loss(device, nullptr)) != found) return "the gradient changes a loss";
      if (first.empty()) {
        value = found;
        first = gradient;
      }
      if (found != value || !have_same_bits(gradient, first))
        return "a loss changes with the order of threads, seed " + std::to_string(seed);
    }
    const double error = max_abs_difference(cpu, first);
    if (!(is_fused ? have_same_bits(cpu, first) : error <= 1e-4 * max_abs(cpu)))
      return "a loss's gradient differs from the CPU's by " + std::to_string(error);
    if (!(std::abs(value - expected) <= 1e-6 * (std::abs(expected) + 1)))
      return "a loss is " + std::to_string(value) + ", on the CPU " + std::to_string(expected);
    return {};
  };
  for (const auto& [planes, height, width] : {std::array<int, 3>{1, 11, 11}, {2, 27, 43}, {3, 12, 75}})
    for (const auto& [l1_weight, ssim_weight] : {std::array<double, 2>{0.8, 0}, {0, 1}, {0.8, -0.2}}) {
      const size_t size = size_t(planes * height * width);
      const Numbers pictures = numbers(size), photos = numbers(size);
      const raster::PhotometricJob<float> job{pictures.data(), photos.data(), planes, width, height};
      const double a = l1_weight, s = ssim_weight;
      const std::string found = difference(
          size, [&](float* gradient) { return raster::photometric<float>(job, a, s, gradient, 1); },
          [&](const cuda::Device& device, float* gradient) { return cuda::photometric(device, job, a, s, gradient); });
      if (!found.empty()) return found;
    }
  for (const auto& [views, height, width] : {std::array<int, 3>{1, 1, 1}, {3, 12, 37}, {2, 17, 1}}) {
    const size_t size = size_t(views * height * width);
    Numbers depths = numbers(size);
    const Numbers photos = numbers(3 * size);
    for (size_t k = 0; k < size; k += 7) depths[k] = 0;
    const raster::SmoothnessJob<float> job{depths.data(), photos.data(), views, width, height};
    const std::string found = difference(
        size, [&](float* gradient) { return raster::depth_smoothness<float>(job, 0.3, gradient, 1); },
        [&](const cuda::Device& device, float* gradient) { return cuda::depth_smoothness(device, job, 0.3, gradient); });
    if (!found.empty()) return found;
  }
  return {};
}

}  // namespace globalsplat::checks
