#include "schedules.h"

#include <array>
#include <cmath>
#include <cstdio>
#include <cstring>

#include "../cuda/emulated.h"
#include "../cuda/fitting.h"
#include "../cuda/frame.h"
#include "../kernels/kernels.h"

namespace globalsplat::checks {
namespace {

using Numbers = std::vector<float>;

// Outputs of a render, for all scenes and views consecutively.
struct RenderResult {
  Numbers rgb, alpha, depth, means, scales, quaternions, opacities, sh, w2c;
  std::vector<Numbers*> all() { return {&rgb, &alpha, &depth, &means, &scales, &quaternions, &opacities, &sh, &w2c}; }
  static constexpr size_t kPictures = 3;  // number of images, which come first
};

void append(Numbers& to, const Numbers& more) { to.insert(to.end(), more.begin(), more.end()); }

// Returns gradients with respect to the images.
Numbers random_gradients(Random& random, size_t count) {
  Numbers numbers;
  for (const double value : random.uniform(count, -1, 1)) numbers.push_back(float(value));
  return numbers;
}

size_t count_of(const Scene<float>& scene) { return scene.gaussians.empty() ? 0 : scene.gaussians[0].opacities.size(); }

RenderResult emptied(const Scene<float>& scene) {
  const size_t pixels = size_t(scene.width) * size_t(scene.height) * scene.views.size();
  const size_t count = count_of(scene) * scene.gaussians.size();
  const auto empty = [](size_t numbers) { return Numbers(numbers, std::nanf("")); };
  return {empty(3 * pixels), empty(pixels), empty(pixels), empty(3 * count), empty(3 * count), empty(4 * count),
          empty(count), empty(size_t(scene.bases) * 3 * count), empty(16 * scene.views.size())};
}

RenderResult by_kernels(const Scene<float>& scene, uint64_t seed) {
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
  const Numbers g_rgb = random_gradients(random, 3 * pixels), g_alpha = random_gradients(random, pixels), g_depth = random_gradients(random, pixels);

  const int64_t scenes = int64_t(scene.gaussians.size());
  const cuda::Arguments arguments{{means.data(), scales.data(), quaternions.data(), opacities.data(), sh.data(),
                                   int64_t(count_of(scene)), scene.bases},
                                  w2c.data(), intrinsics.data(), scenes,
                                  scenes == 0 ? 0 : int64_t(scene.views.size()) / scenes, scene.width, scene.height, 0.05};
  RenderResult result = emptied(scene);
  const cuda::emulated::Emulator device(seed);
  const cuda::Frame frame(device, arguments, {result.rgb.data(), result.alpha.data(), result.depth.data()});
  frame.backward(device, arguments, {result.rgb.data(), result.alpha.data(), result.depth.data()},
                 {g_rgb.data(), g_alpha.data(), g_depth.data()},
                 {result.means.data(), result.scales.data(), result.quaternions.data(), result.opacities.data(), result.sh.data()},
                 result.w2c.data());
  return result;
}

RenderResult by_cpu(const Scene<float>& scene) {
  const size_t pixels = size_t(scene.width) * size_t(scene.height), views = scene.views.size(), count = count_of(scene);
  Random random(9);
  const Numbers g_rgb = random_gradients(random, 3 * pixels * views), g_alpha = random_gradients(random, pixels * views);
  const Numbers g_depth = random_gradients(random, pixels * views);
  RenderResult result = emptied(scene);
  std::vector<raster::Gaussians<float>> gaussians;
  std::vector<raster::GaussianGradients<float>> out;
  for (size_t b = 0; b < scene.gaussians.size(); ++b) {
    const Arrays<float>& g = scene.gaussians[b];
    gaussians.push_back({g.means.data(), g.scales.data(), g.quaternions.data(), g.opacities.data(), g.sh.data(), int64_t(count),
                         scene.bases});
    out.push_back({result.means.data() + 3 * count * b, result.scales.data() + 3 * count * b, result.quaternions.data() + 4 * count * b,
                   result.opacities.data() + count * b, result.sh.data() + size_t(scene.bases) * 3 * count * b});
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
  const auto frame = raster::Frame<float>::draw(gaussians, scene.views, {scene.width, scene.height, 0.05, 2}, outputs, times);
  frame->backward(gaussians, pictures, gradients, out, cameras.data(), times);
  for (size_t k = 0; k < views; ++k)
    for (int number = 0; number < 16; ++number) {
      const int row = number / 4, column = number % 4;
      result.w2c[16 * k + size_t(number)] =
          row == 3 ? 0 : cameras[k].numbers[column < 3 ? 3 * row + column : 9 + row];
    }
  return result;
}

bool same(const Numbers& a, const Numbers& b) {
  return a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0);
}

double largest(const Numbers& numbers) {
  double most = 0;
  for (const float number : numbers) most = std::max(most, std::abs(double(number)));
  return most;
}

double distance(const Numbers& a, const Numbers& b) {
  double most = 0;
  for (size_t k = 0; k < a.size(); ++k) most = std::max(most, std::abs(double(a[k]) - double(b[k])));
  return most;
}

}  // namespace

std::string schedules_differ(const Scene<float>& scene, const std::vector<uint64_t>& seeds) {
  const char* const names[] = {"colours", "opacities", "depths", "means", "scales", "quaternions", "opacities' gradients",
                               "spherical harmonics", "cameras"};
  RenderResult cpu = by_cpu(scene), first = by_kernels(scene, seeds[0]);
  // Infinite values and NaN spread to pixels nearby: on the CPU within a block, here within two.
  const bool is_strange = scene.name.rfind("strange", 0) == 0;
  double slope = 0;
  for (size_t k = RenderResult::kPictures; k < cpu.all().size(); ++k) slope = std::max(slope, largest(*cpu.all()[k]));
  for (size_t k = 0; k < first.all().size() && !is_strange; ++k) {
    const Numbers &ours = *first.all()[k], &theirs = *cpu.all()[k];
    // Some gradients, such as that of a sphere's rotation, are differences of larger values that cancel.
    const double off = distance(ours, theirs), most = k < RenderResult::kPictures ? 0 : 1e-3 * largest(theirs) + 1e-5 * slope;
    if (!(off <= most)) return std::string(names[k]) + " differ from the CPU's by " + std::to_string(off);
  }
  for (size_t n = 1; n < seeds.size(); ++n) {
    RenderResult other = by_kernels(scene, seeds[n]);
    for (size_t k = 0; k < first.all().size(); ++k)
      if (!same(*first.all()[k], *other.all()[k]))
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
  return sums[0] == expected[0] && sums[1] == expected[1] && total == totals[0] ? "" : "sums of what is before differ";
}

std::string fits_differ(const std::vector<uint64_t>& seeds) {
  Random random(12);
  const auto numbers = [&](size_t count) {
    Numbers values;
    for (const double value : random.uniform(count, 0, 1)) values.push_back(float(value));
    return values;
  };
  const auto sum_of = [](const cuda::Parts& parts) {
    double sum = 0;
    for (int64_t k = 0; k < parts.count; ++k) sum += static_cast<const double*>(parts.numbers.get())[k];
    return sum;
  };
  // Instruction sets without fused multiply-add round products before adding them.
  const bool is_fused = std::strcmp(raster::kernels().name, "portable") != 0;
  // by_cpu(gradient) and by_kernels(device, gradient) return a loss, and write the gradient's `all` values unless it is null.
  const auto difference = [&](size_t all, const auto& by_cpu, const auto& by_kernels) -> std::string {
    Numbers cpu(all), first;
    const double expected = by_cpu(cpu.data());
    double value = 0;
    for (const uint64_t seed : seeds) {
      const cuda::emulated::Emulator device(seed);
      Numbers gradient(all, std::nanf(""));
      const double found = sum_of(by_kernels(device, gradient.data()));
      if (sum_of(by_kernels(device, nullptr)) != found) return "the gradient changes a loss";
      if (first.empty()) {
        value = found;
        first = gradient;
      }
      if (found != value || !same(gradient, first)) return "a loss changes with the order of threads, seed " + std::to_string(seed);
    }
    const double off = distance(cpu, first);
    if (!(is_fused ? same(cpu, first) : off <= 1e-4 * largest(cpu)))
      return "a loss's gradient differs from the CPU's by " + std::to_string(off);
    if (!(std::abs(value - expected) <= 1e-6 * (std::abs(expected) + 1))) return "a loss is " + std::to_string(value) + ", on the CPU " + std::to_string(expected);
    return {};
  };
  for (const auto& [planes, height, width] : {std::array<int, 3>{1, 11, 11}, {2, 27, 43}, {3, 12, 75}})
    for (const auto& [l1_weight, ssim_weight] : {std::array<double, 2>{0.8, 0}, {0, 1}, {0.8, -0.2}}) {
      const size_t all = size_t(planes * height * width);
      const Numbers pictures = numbers(all), photos = numbers(all);
      const raster::FitJob<float> job{pictures.data(), photos.data(), planes, width, height};
      const double a = l1_weight, s = ssim_weight;
      const std::string found = difference(
          all, [&](float* gradient) { return raster::photometric<float>(job, a, s, gradient, 1); },
          [&](const cuda::Device& device, float* gradient) { return cuda::photometric(device, job, a, s, gradient); });
      if (!found.empty()) return found;
    }
  for (const auto& [views, height, width] : {std::array<int, 3>{1, 1, 1}, {3, 12, 37}, {2, 17, 1}}) {
    const size_t all = size_t(views * height * width);
    Numbers depths = numbers(all);
    const Numbers photos = numbers(3 * all);
    for (size_t k = 0; k < all; k += 7) depths[k] = 0;
    const raster::DepthJob<float> job{depths.data(), photos.data(), views, width, height};
    const std::string found = difference(
        all, [&](float* gradient) { return raster::depth_smoothness<float>(job, 0.3, gradient, 1); },
        [&](const cuda::Device& device, float* gradient) { return cuda::depth_smoothness(device, job, 0.3, gradient); });
    if (!found.empty()) return found;
  }
  return {};
}

}  // namespace globalsplat::checks
