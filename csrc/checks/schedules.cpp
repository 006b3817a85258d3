#include <cmath>

#include "../cuda/device.h"
#include "../cuda/frame.h"
#include "checks.h"

namespace globalsplat::checks {
namespace {

using cuda::emulated::Emulator;
using Numbers = std::vector<float>;

// Renders with the GPU kernels, forward and backward. Images must have the bits of the CPU backend's, so that every list is right;
// parity/ compares the gradients.
int64_t check_render(const Scene<float>& scene, const std::vector<int>& seeds) {
  Render<float> cpu(scene, 2);
  cpu.draw();
  const Results<float> images(cpu.results.begin(), cpu.results.begin() + 3);
  // Infinite values and NaN spread to other pixels: of a block on the CPU, of two blocks in the kernels. These scenes aren't compared.
  const bool has_special_values = scene.name.rfind("special", 0) == 0;
  return check_same_bits(scene.name + ", in orders of kernels, " + std::to_string(scene.bases) + " bases", seeds, [&](int seed) {
    Render<float> render(scene, 0);
    for (Numbers& numbers : render.results) std::fill(numbers.begin(), numbers.end(), std::nanf(""));
    const Emulator device{uint64_t(seed)};
    const cuda::Frame frame(device, scene.arguments(), render.images());
    if (!has_special_values) expect_same(Results<float>(render.results.begin(), render.results.begin() + 3), images);
    frame.backward(device, scene.arguments(), render.drawn_images(), render.image_gradients(), render.gradients(),
                   render.results[9].data());
    return render.results;
  });
}

// Checks the prefix sums that sorting needs, with more counts than one block processes, which only huge scenes have.
void check_sums(int seed) {
  begin("prefix sums of kernels");
  const size_t lengths[2] = {5000, 1500};
  Random random{uint64_t(seed)};
  std::vector<uint32_t> counts[2], sums[2], expected[2];
  uint64_t total = 0, totals[2] = {};
  for (int row = 0; row < 2; ++row) {
    for (const double value : random.uniform(lengths[row], 0, 100)) {
      counts[row].push_back(uint32_t(value));
      expected[row].push_back(uint32_t(totals[row]));
      totals[row] += counts[row].back();
    }
    sums[row].resize(lengths[row]);
  }
  using cuda::gs_scan;
  const auto row_of = [&](int row) { return cuda::Counts{int64_t(lengths[row]), counts[row].data(), sums[row].data()}; };
  GS_LAUNCH(Emulator(uint64_t(seed)), gs_scan, (cuda::Blocks{3, 2}), cuda::kScanThreads, row_of(0), row_of(1), &total);
  expect(sums[0] == expected[0] && sums[1] == expected[1] && total == totals[0], "they differ from the sums in order");
}

double sum_of(const cuda::PartialSums& parts) {
  double sum = 0;
  for (int64_t k = 0; k < parts.count; ++k) sum += static_cast<const double*>(parts.numbers.get())[k];
  return sum;
}

}  // namespace

int64_t check_orders(bool is_short) {
  const std::vector<int> seeds = is_short ? std::vector<int>{1, 2} : std::vector<int>{1, 2, 3, 4, 5};
  for (const int seed : seeds) check_sums(seed);
  const int64_t count = check_losses<float>(
      seeds,
      [](int seed, const raster::LossJob<float>& job, double l1_weight, double ssim_weight, float* gradient) {
        return sum_of(cuda::photometric(Emulator{uint64_t(seed)}, job, l1_weight, ssim_weight, gradient));
      },
      [](int seed, const raster::LossJob<float>& job, float* gradient) {
        return sum_of(cuda::depth_smoothness(Emulator{uint64_t(seed)}, job, 0.3, gradient));
      });
  return count + for_all_scenes(is_short, [&](const Scene<double>& scene) {
    const bool is_large = scene.arguments().gaussians.count * scene.width * scene.height > 1'000'000;
    return is_short && is_large ? 0 : check_render(as<float>(scene), seeds);
  });
}

}  // namespace globalsplat::checks
