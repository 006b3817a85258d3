// Gaussians and cameras drawn with fixed seeds: random scenes, scenes with special values such as NaN, and scenes that are large enough to
// split the work of every stage.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "../kernels/raster.h"

namespace globalsplat::checks {

// Scenes with the same number of Gaussians and of cameras. The arrays have the layout of raster::Arguments. Each is a separate vector, so that
// AddressSanitizer detects out-of-bounds reads.
template <class T>
struct Scene {
  std::string name;
  int width, height, bases;  // bases: spherical harmonics per channel
  int batch, cameras;        // scenes, and cameras of each
  std::vector<T> means{}, scales{}, quaternions{}, opacities{}, sh{};
  std::vector<T> w2c{}, intrinsics{};
  raster::ProjectionSettings projection{0.05};

  raster::Arguments<T> arguments() const {
    const int64_t count = batch == 0 ? 0 : int64_t(opacities.size()) / batch;
    return {{means.data(), scales.data(), quaternions.data(), opacities.data(), sh.data(), count, bases},
            w2c.data(), intrinsics.data(), batch, cameras, width, height, projection};
  }
};

// Converts values to type T.
template <class T>
std::vector<T> converted(const std::vector<double>& values) {
  return std::vector<T>(values.begin(), values.end());
}

// Converts a scene to numbers of type T.
template <class T>
Scene<T> as(const Scene<double>& s) {
  return {s.name, s.width, s.height, s.bases, s.batch, s.cameras, converted<T>(s.means), converted<T>(s.scales), converted<T>(s.quaternions),
          converted<T>(s.opacities), converted<T>(s.sh), converted<T>(s.w2c), converted<T>(s.intrinsics), s.projection};
}

class Random {
 public:
  explicit Random(uint64_t seed) : bits_(seed) {}
  double uniform(double low, double high) { return low + (high - low) * std::ldexp(double(bits_() >> 11), -53); }
  double normal(double deviation = 1) {
    return deviation * std::sqrt(-2 * std::log(1 - uniform(0, 1))) * std::cos(6.283185307179586 * uniform(0, 1));
  }
  std::vector<double> uniform(size_t n, double low, double high) {
    std::vector<double> values(n);
    for (double& value : values) value = uniform(low, high);
    return values;
  }
  std::vector<double> normal(size_t n, double deviation) {
    std::vector<double> values(n);
    for (double& value : values) value = normal(deviation);
    return values;
  }

 private:
  std::mt19937_64 bits_;
};

// Appends a camera at a random place near the origin, with a small random rotation.
inline void add_camera(Scene<double>& scene, Random& random) {
  const double side = std::max(scene.width, scene.height);
  const double x = random.normal(0.04), y = random.normal(0.04), z = random.normal(0.04);  // of the quaternion (1, x, y, z)
  const double s = 2 / (1 + x * x + y * y + z * z);
  const double t[3] = {random.normal(0.2), random.normal(0.2), random.normal(0.2)};
  scene.w2c.insert(scene.w2c.end(), {1 - s * (y * y + z * z), s * (x * y - z), s * (x * z + y), t[0],      //
                                     s * (x * y + z), 1 - s * (x * x + z * z), s * (y * z - x), t[1],      //
                                     s * (x * z - y), s * (y * z + x), 1 - s * (x * x + y * y), t[2], 0, 0, 0, 1});
  scene.intrinsics.insert(scene.intrinsics.end(), {side * random.uniform(0.8, 1.2), 0, scene.width * random.uniform(0.4, 0.6), 0,
                                                   side * random.uniform(0.8, 1.2), scene.height * random.uniform(0.4, 0.6), 0, 0, 1});
}

// Creates a scene whose splats have sizes from less than a pixel to a third of the image, and opacities from 0 to 1. Some are outside of
// the image.
inline Scene<double> random_scene(Random& random, std::string name, int width, int height, int batch, int cameras, size_t count,
                                  int bases) {
  Scene<double> scene{name, width, height, bases, batch, cameras};
  const double side = std::max(width, height);
  const size_t all = count * size_t(batch);
  for (size_t i = 0; i < all; ++i) {
    const double depth = random.uniform(1, 5);
    scene.means.insert(scene.means.end(), {random.uniform(-0.8, 0.8) * depth, random.uniform(-0.8, 0.8) * depth, depth});
    for (int k = 0; k < 3; ++k)
      scene.scales.push_back(std::exp(random.uniform(std::log(0.3), std::log(0.3 * side + 1))) * depth / side);
  }
  scene.quaternions = random.normal(4 * all, random.uniform(0.2, 3));
  scene.opacities = random.uniform(all, 0, 1);
  scene.sh = random.normal(size_t(bases) * 3 * all, 0.3);
  for (int c = 0; c < batch * cameras; ++c) add_camera(scene, random);
  return scene;
}

// Returns all scenes but many_gaussians(). Each is a random scene, some with other values in places.
inline std::vector<Scene<double>> all_scenes(int bases) {
  Random random(7);
  std::vector<Scene<double>> scenes;
  const auto add = [&](const char* name, int width, int height, int batch, int cameras, size_t count) -> Scene<double>& {
    return scenes.emplace_back(random_scene(random, name, width, height, batch, cameras, count, bases));
  };
  // Adds a scene of one camera, which isn't moved or rotated, and calls edit(mean, scale, opacity, i) for every Gaussian.
  const auto add_edited = [&](const char* name, size_t count, const auto& edit) -> Scene<double>& {
    Scene<double>& scene = add(name, 48, 33, 1, 1, count);
    for (size_t k = 0; k < 12; ++k) scene.w2c[k] = k % 5 == 0;
    for (size_t i = 0; i < count; ++i) edit(&scene.means[3 * i], &scene.scales[3 * i], scene.opacities[i], i);
    return scene;
  };
  // Moves a Gaussian to another depth, at the same place in the image and with the same size there.
  const auto move = [](double* mean, double* scale, double depth) {
    const double factor = std::max(std::abs(depth), 1e-3) / mean[2];
    for (int k = 0; k < 3; ++k) mean[k] *= factor, scale[k] *= factor;
    mean[2] = depth;
  };

  add("two scenes, two views", 40, 24, 2, 2, 50);
  add("three views", 19, 31, 1, 3, 30);
  add("three scenes", 16, 16, 3, 1, 20);
  add("a wide picture", 50, 9, 1, 1, 40);
  add("a single pixel", 1, 1, 2, 2, 12);
  add("17x3", 17, 3, 1, 2, 20);
  add("257x255", 257, 255, 1, 1, 24);
  add("several tasks", 70, 50, 1, 2, 1300);
  add("no scene", 16, 16, 0, 0, 0);
  add("no view", 16, 16, 1, 0, 5);
  add("no Gaussian", 48, 33, 1, 1, 0);
  add("a long list", 8, 8, 1, 1, 10000);  // a tile has more pairs than a GPU sorts in shared memory

  add_edited("near plane", 30, [&](double* mean, double* scale, double&, size_t i) {
    const double just_above = std::nextafter(0.01f, 1.f);
    const double depths[] = {-3, -0.01, 0, 1e-9, 0.0099, 0.01, just_above, 0.0101, 0.02, 0.1};
    move(mean, scale, depths[i % 10]);
  });
  add_edited("far outside", 24, [](double* mean, double* scale, double&, size_t i) {
    const double factors[] = {2, 10, 1000};
    for (int k = 0; k < 3; ++k) scale[k] *= factors[i / 8], mean[k] *= k < 2 ? factors[i / 8] : 1;
  });
  add_edited("needles and discs", 24, [](double*, double* scale, double&, size_t i) {
    const double scales[][3] = {{1e-7, 1e-7, 1}, {1, 1e-7, 1}, {1e-3, 1e-4, 0.5}, {1e-12, 1e-12, 1e-12}};
    std::copy_n(scales[i % 4], 3, scale);
  });
  add_edited("huge", 8, [&](double*, double* scale, double&, size_t) {
    for (int k = 0; k < 3; ++k) scale[k] = std::pow(10, random.uniform(1, 3));
  });
  // There are more pairs than the initial allocation holds.
  Scene<double>& pairs = add("huge in many tiles", 128, 96, 1, 1, 150);
  pairs.scales = random.uniform(450, 5, 50);
  for (double& opacity : pairs.opacities) opacity *= 0.05;
  add_edited("opacities", 24, [](double*, double*, double& opacity, size_t i) {
    const double opacities[] = {0, 1e-12, 0.0039, 0.0040, 0.5, 1};  // 1/255 is 0.00392
    opacity = opacities[i % 6];
  });
  Scene<double>& equal = add_edited("equal depths", 30, [&](double* mean, double* scale, double&, size_t) { move(mean, scale, 2); });
  std::copy_n(equal.means.begin(), 30, equal.means.begin() + 60);
  Scene<double>& borders = add_edited("tile borders", 20, [](double* mean, double* scale, double&, size_t i) {
    const double v[] = {0, 16, 16.5, 32, 33}, sizes[] = {0.001, 0.0625, 1, 0.5};
    const double values[] = {double(i % 4) - 1.5, (v[i / 4] - 16.5) / 16, 2};
    std::copy_n(values, 3, mean);
    std::fill_n(scale, 3, sizes[(i + i / 4) % 4]);
  });
  borders.intrinsics = {32, 0, 24, 0, 32, 16.5, 0, 0, 1};
  add_edited("opaque stack", 60, [](double* mean, double* scale, double& opacity, size_t i) {
    mean[0] *= 0.2, mean[1] *= 0.2, mean[2] = 1 + 3 * double(i) / 59;
    std::fill_n(scale, 3, 1);
    opacity = 0.3 + 0.7 * opacity;
  });
  add_edited("all behind", 5, [](double* mean, double*, double&, size_t) { mean[2] *= -1; });

  std::vector<double>& quaternions = add("quaternions of any length", 48, 33, 1, 2, 45).quaternions;
  for (size_t k = 0; k < quaternions.size(); ++k) quaternions[k] *= std::exp2(25. * double(k / 4 % 9) - 100);

  // For each special value, 15 Gaussians that have it in one component each.
  const double infinity = std::numeric_limits<double>::infinity();
  const std::vector<double> special = {std::nan(""), infinity, -infinity, 0,     -1,   1e-45,
                                       1e-30,        1e30,     3e38,      -3e38, 1e18, 1e5};
  Scene<double>& g = add("special values", 48, 33, 1, 2, 15 * special.size() + 4);
  for (size_t n = 0; n < special.size(); ++n) {
    size_t i = 15 * n;
    for (size_t k = 0; k < 3; ++k) g.means[3 * i++ + k] = special[n];
    for (size_t k = 0; k < 3; ++k) g.scales[3 * i++ + k] = special[n];
    for (size_t k = 0; k < 4; ++k) g.quaternions[4 * i++ + k] = special[n];
    for (size_t k = 0; k < 4; ++k) g.sh[size_t(bases) * 3 * i++ + k % size_t(3 * bases)] = special[n];
    g.opacities[i] = special[n];
  }
  for (size_t k = 0; k < 4; ++k) g.quaternions[60 * special.size() + k] = 0;  // a quaternion of length 0

  // Cameras with each special value in four of their parameters.
  Scene<double>& views = add("special values of cameras", 17, 9, 1, int(4 * special.size()), 6);
  for (size_t n = 0; n < 4 * special.size(); ++n) {
    double *const k = &views.intrinsics[9 * n], *const pose = &views.w2c[16 * n];
    double* const places[] = {k, k + 5, pose + 5, pose + 11};  // f_x, c_y, a diagonal element of the rotation, the depth of the origin
    *places[n % 4] = special[n / 4];
  }

  // Every scene is antialiased with two of the four numbers of bases. A third of those with a single basis function have colors instead.
  for (size_t i = 0; i < scenes.size(); ++i) {
    scenes[i].projection.antialiased = (i + size_t(bases)) % 2 == 1;
    scenes[i].projection.direct_colors = bases == 1 && i % 3 == 0;
  }
  return scenes;
}

// Creates a scene with more Gaussians than are sorted and binned in one chunk.
inline Scene<double> many_gaussians(int bases) {
  Random random(8);
  return random_scene(random, "crowd", 20, 20, 1, 1, 66000, bases);
}

}  // namespace globalsplat::checks
