#include "render.h"

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

// Renders with the GPU kernels in the emulator, forward and backward from the images' `output_gradients`. `seed` determines the order of blocks and
// threads. The results have the sizes of `like`.
Results<float> render_emulated(const Scene<float>& scene, const Results<float>& output_gradients, const Results<float>& like, uint64_t seed) {
  Results<float> out;
  for (const Numbers& numbers : like) out.emplace_back(numbers.size(), std::nanf(""));
  const cuda::emulated::Emulator device(seed);
  const cuda::Frame frame(device, scene.arguments(), {out[0].data(), out[1].data(), out[2].data()});
  frame.backward(device, scene.arguments(), pictures(out), pictures(output_gradients), gradients(out), out[9].data());
  return out;
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

// Renders `scene`, forward and backward, with the CPU backend and with the kernels, once per seed; a seed determines the order of blocks
// and threads. Images must have the CPU's bits, gradients must be close to the CPU's, and all orders must give the same bits.
void check_render(const Scene<float>& scene, const std::vector<uint64_t>& seeds) {
  Render<float> render(scene, 2);
  render.draw();
  render.backward();
  const Results<float>& cpu = render.results();
  const Results<float> first = render_emulated(scene, render.output_gradients(), cpu, seeds[0]);
  // Infinite values and NaN spread to other pixels: of a block on the CPU, of two blocks in the kernels. These scenes aren't compared.
  const bool has_special_values = scene.name.rfind("special", 0) == 0;
  double max_gradient = 0;
  for (size_t k = kImages; k < cpu.size(); ++k) max_gradient = std::max(max_gradient, max_abs(cpu[k]));
  for (size_t k = 0; k < first.size() && !has_special_values; ++k) {
    // Some gradients, such as that of a sphere's rotation, are differences of larger values that cancel. So the tolerance also depends on
    // the largest of all gradients.
    const double error = max_abs_difference(first[k], cpu[k]);
    const double tolerance = k < kImages ? 0 : 1e-3 * max_abs(cpu[k]) + 1e-5 * max_gradient;
    expect(error <= tolerance, std::string(kResults[k]) + " differ from the CPU's by " + std::to_string(error));
  }
  for (size_t n = 1; n < seeds.size(); ++n) {
    const Results<float> other = render_emulated(scene, render.output_gradients(), cpu, seeds[n]);
    for (size_t k = 0; k < first.size(); ++k)
      expect(have_same_bits(first[k], other[k]),
             std::string(kResults[k]) + " change with the order of threads, seed " + std::to_string(seeds[n]));
  }
}

// Checks the prefix sums that sorting needs, with more counts than one block processes.
void check_sums(uint64_t seed) {
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
  expect(sums[0] == expected[0] && sums[1] == expected[1] && total == totals[0], "prefix sums differ");
}

// Checks the losses that compare images with photos, and their gradients.
void check_losses(const std::vector<uint64_t>& seeds) {
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
  const auto compare = [&](size_t size, const auto& cpu_loss, const auto& device_loss) {
    Numbers cpu(size), first;
    const double expected = cpu_loss(cpu.data());
    double value = 0;
    for (const uint64_t seed : seeds) {
      const cuda::emulated::Emulator device(seed);
      Numbers gradient(size, std::nanf(""));
      const double found = sum_of(device_loss(device, gradient.data()));
      expect(sum_of(device_loss(device, nullptr)) == found, "the gradient changes a loss");
      if (first.empty()) {
        value = found;
        first = gradient;
      }
      expect(found == value && have_same_bits(gradient, first),
             "a loss changes with the order of threads, seed " + std::to_string(seed));
    }
    const double error = max_abs_difference(cpu, first);
    expect(is_fused ? have_same_bits(cpu, first) : error <= 1e-4 * max_abs(cpu),
           "a loss's gradient differs from the CPU's by " + std::to_string(error));
    expect(std::abs(value - expected) <= 1e-6 * (std::abs(expected) + 1),
           "a loss is " + std::to_string(value) + ", on the CPU " + std::to_string(expected));
  };
  for (const auto& [planes, height, width] : {std::array<int, 3>{1, 11, 11}, {2, 27, 43}, {3, 12, 75}})
    for (const auto& [l1_weight, ssim_weight] : {std::array<double, 2>{0.8, 0}, {0, 1}, {0.8, -0.2}}) {
      const size_t size = size_t(planes * height * width);
      const Numbers pictures = numbers(size), photos = numbers(size);
      const raster::LossJob<float> job{pictures.data(), photos.data(), planes, width, height};
      const double a = l1_weight, s = ssim_weight;
      compare(
          size, [&](float* gradient) { return raster::photometric<float>(job, a, s, gradient, 1); },
          [&](const cuda::Device& device, float* gradient) { return cuda::photometric(device, job, a, s, gradient); });
    }
  for (const auto& [views, height, width] : {std::array<int, 3>{1, 1, 1}, {3, 12, 37}, {2, 17, 1}}) {
    const size_t size = size_t(views * height * width);
    Numbers depths = numbers(size);
    const Numbers photos = numbers(3 * size);
    for (size_t k = 0; k < size; k += 7) depths[k] = 0;
    const raster::LossJob<float> job{depths.data(), photos.data(), views, width, height};
    compare(
        size, [&](float* gradient) { return raster::depth_smoothness<float>(job, 0.3, gradient, 1); },
        [&](const cuda::Device& device, float* gradient) { return cuda::depth_smoothness(device, job, 0.3, gradient); });
  }
}

}  // namespace

int64_t orders(bool is_short) {
  const std::vector<uint64_t> seeds = is_short ? std::vector<uint64_t>{1, 2} : std::vector<uint64_t>{1, 2, 3, 4, 5};
  begin("sums of kernels");
  for (const uint64_t seed : seeds) check_sums(seed);
  begin("losses of kernels");
  check_losses(seeds);
  int64_t count = 2 * int64_t(seeds.size());
  size_t turn = 0;
  for (const int bases : {1, 4, 9, 16}) {
    const std::vector<Scene<double>> scenes = all_scenes(bases);
    for (size_t i = 0; i < scenes.size(); ++i) {
      const bool is_large = scenes[i].arguments().gaussians.count * scenes[i].width * scenes[i].height > 1'000'000;
      if (is_short && (i % 4 != turn || is_large)) continue;
      begin(scenes[i].name + ", in orders of kernels, " + std::to_string(bases) + " bases");
      check_render(as<float>(scenes[i]), seeds);
      count += int64_t(seeds.size());
    }
    ++turn;
  }
  return count;
}

}  // namespace globalsplat::checks
