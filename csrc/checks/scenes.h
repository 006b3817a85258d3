// Gaussians and cameras drawn with fixed seeds: scenes like those of parity/harness/scenes.py, scenes with special values such as NaN, and
// scenes that are large enough to split the work of every stage.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>
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

class Random {
 public:
  explicit Random(uint64_t seed) : bits_(seed) {}
  double uniform(double low, double high) { return low + (high - low) * std::ldexp(double(bits_() >> 11), -53); }
  double normal() { return std::sqrt(-2 * std::log(1 - uniform(0, 1))) * std::cos(6.283185307179586 * uniform(0, 1)); }
  std::vector<double> uniform(size_t n, double low, double high) {
    std::vector<double> values(n);
    for (double& value : values) value = uniform(low, high);
    return values;
  }
  std::vector<double> normal(size_t n, double deviation) {
    std::vector<double> values(n);
    for (double& value : values) value = deviation * normal();
    return values;
  }

 private:
  std::mt19937_64 bits_;
};

// Converts values to type T.
template <class T>
std::vector<T> converted(const std::vector<double>& values) {
  return std::vector<T>(values.begin(), values.end());
}

template <class Item>
bool have_same_bits(const std::vector<Item>& a, const std::vector<Item>& b) {
  return a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(Item)) == 0);
}

// Appends the camera with the rotation of the quaternion (1, x, y, z), not normalized.
inline void add_camera(Scene<double>& scene, const double (&q)[3], const double (&t)[3], double fx, double fy, double cx, double cy) {
  const auto [x, y, z] = q;
  const double s = 2 / (1 + x * x + y * y + z * z);
  scene.w2c.insert(scene.w2c.end(), {1 - s * (y * y + z * z), s * (x * y - z), s * (x * z + y), t[0],      //
                                     s * (x * y + z), 1 - s * (x * x + z * z), s * (y * z - x), t[1],      //
                                     s * (x * z - y), s * (y * z + x), 1 - s * (x * x + y * y), t[2], 0, 0, 0, 1});
  scene.intrinsics.insert(scene.intrinsics.end(), {fx, 0, cx, 0, fy, cy, 0, 0, 1});
}

inline void append(std::vector<double>& to, const std::vector<double>& more) { to.insert(to.end(), more.begin(), more.end()); }

// Creates a scene whose splats have sizes from less than a pixel to a third of the image, and opacities from 0 to 1. Some are outside of
// the image.
inline Scene<double> random_scene(Random& random, std::string name, int width, int height, int batch, int cameras, size_t count,
                                  int bases) {
  Scene<double> scene{name, width, height, bases, batch, cameras};
  const double side = std::max(width, height);
  for (int b = 0; b < batch; ++b) {
    for (size_t i = 0; i < count; ++i) {
      const double depth = random.uniform(1, 5);
      for (int k = 0; k < 3; ++k) {
        scene.means.push_back(k == 2 ? depth : random.uniform(-0.8, 0.8) * depth);
        scene.scales.push_back(std::exp(random.uniform(std::log(0.3), std::log(0.3 * side + 1))) * depth / side);
      }
    }
    append(scene.quaternions, random.normal(4 * count, random.uniform(0.2, 3)));
    append(scene.opacities, random.uniform(count, 0, 1));
    append(scene.sh, random.normal(size_t(bases) * 3 * count, 0.3));
    for (int c = 0; c < cameras; ++c)
      add_camera(scene, {0.04 * random.normal(), 0.04 * random.normal(), 0.04 * random.normal()},
                 {0.2 * random.normal(), 0.2 * random.normal(), 0.2 * random.normal()}, side * random.uniform(0.8, 1.2),
                 side * random.uniform(0.8, 1.2), width * random.uniform(0.4, 0.6), height * random.uniform(0.4, 0.6));
  }
  return scene;
}

// Creates a scene of the given Gaussians, with random rotations and colors. The first camera is at the origin, without rotation; others
// are translated.
inline Scene<double> make_scene(Random& random, std::string name, int bases, std::vector<double> means,
                                std::vector<double> scales, std::vector<double> opacities, int cameras = 1, int width = 48,
                                int height = 33) {
  const size_t count = opacities.size();
  Scene<double> scene{name, width, height, bases, 1, cameras, means, scales, random.normal(4 * count, 1), opacities,
                      random.normal(size_t(bases) * 3 * count, 0.3)};
  for (int c = 0; c < cameras; ++c) add_camera(scene, {0, 0, 0}, {0.25 * c, 0, -0.5 * c}, 32, 32, 0.5 * width, 0.5 * height);
  return scene;
}

// Returns means at the given depths, within the view of the first camera of make_scene(), or within a part of it if `spread` is smaller.
inline std::vector<double> means_at(Random& random, const std::vector<double>& depths, double spread = 0.6) {
  std::vector<double> means;
  for (const double depth : depths)
    means.insert(means.end(), {spread * random.uniform(-1, 1) * depth, spread * random.uniform(-1, 1) * depth, depth});
  return means;
}

// Returns `count` values that repeat `values` cyclically.
inline std::vector<double> repeated(const std::vector<double>& values, size_t count) {
  std::vector<double> out(count);
  for (size_t i = 0; i < count; ++i) out[i] = values[i % values.size()];
  return out;
}

// Returns all scenes but many_gaussians().
inline std::vector<Scene<double>> all_scenes(int bases) {
  Random random(7);
  std::vector<Scene<double>> scenes;
  const auto add_scattered = [&](const char* name, int width, int height, int batch, int cameras, size_t count) {
    scenes.push_back(random_scene(random, name, width, height, batch, cameras, count, bases));
  };
  const auto add = [&](const char* name, std::vector<double> means, std::vector<double> scales,
                       std::vector<double> opacities, int cameras = 1, int width = 48, int height = 33) {
    scenes.push_back(make_scene(random, name, bases, means, scales, opacities, cameras, width, height));
  };
  const auto depths = [&](size_t count) { return random.uniform(count, 1, 3); };

  add_scattered("two scenes, two views", 40, 24, 2, 2, 50);
  add_scattered("three views", 19, 31, 1, 3, 30);
  add_scattered("three scenes", 16, 16, 3, 1, 20);
  add_scattered("a wide picture", 50, 9, 1, 1, 40);
  add_scattered("a single pixel", 1, 1, 2, 2, 12);
  add_scattered("17x3", 17, 3, 1, 2, 20);
  add_scattered("257x255", 257, 255, 1, 1, 24);
  add_scattered("several tasks", 70, 50, 1, 2, 1300);
  add_scattered("no scene", 16, 16, 0, 0, 0);
  add_scattered("no view", 16, 16, 1, 0, 5);

  const double just_above = std::nextafter(0.01f, 1.f);
  std::vector<double> near = {-3, -0.01, 0, 1e-9, 0.0099, 0.01, just_above, 0.0101, 0.02, 0.1};
  near = repeated(near, 30);
  std::vector<double> scales = random.uniform(90, 0.05, 0.4);
  for (size_t i = 0; i < 90; ++i) scales[i] *= std::max(std::abs(near[i / 3]), 1e-3);
  add("near plane", means_at(random, near), scales, repeated({0.4}, 30));

  std::vector<double> means;
  scales.clear();
  for (const double far : {2., 10., 1000.})
    for (int i = 0; i < 8; ++i) {
      const double depth = random.uniform(1, 3);
      means.insert(means.end(), {far * random.uniform(-1, 1) * depth, far * random.uniform(-1, 1) * depth, depth});
      for (int k = 0; k < 3; ++k) scales.push_back(far * depth * random.uniform(0.1, 1));
    }
  add("far outside", means, scales, repeated({0.5}, 24), 2);
  add("needles and discs", means_at(random, depths(24)),
      repeated({1e-7, 1e-7, 1, 1, 1e-7, 1, 1e-3, 1e-4, 0.5, 1e-12, 1e-12, 1e-12}, 72), repeated({0.5}, 24));
  scales = random.uniform(24, 0.5, 1.5);
  for (double& scale : scales) scale *= std::pow(10, random.uniform(1, 3));
  add("huge", means_at(random, depths(8)), scales, repeated({0.3}, 8));
  // There are more pairs than the initial allocation holds.
  add("huge in many tiles", means_at(random, depths(150)), random.uniform(450, 5, 50), random.uniform(150, 0, 0.05), 1, 128, 96);
  add("opacities", means_at(random, depths(24)), random.uniform(72, 0.02, 0.3),
      repeated({0, 1e-12, 0.0039, 0.0040, 0.5, 1}, 24));  // 1/255 is 0.00392
  means = means_at(random, repeated({2}, 30));
  std::copy_n(means.begin(), 30, means.begin() + 60);
  add("equal depths", means, random.uniform(90, 0.05, 0.4), random.uniform(30, 0.1, 0.9), 2);
  means.clear();
  for (const double v : {0., 16., 16.5, 32., 33.})
    for (const double u : {0., 16., 32., 48.}) means.insert(means.end(), {(u - 24) / 16, (v - 16.5) / 16, 2});
  scales.clear();
  const double sizes[] = {0.001, 0.0625, 1, 0.5};
  for (int i = 0; i < 20; ++i) scales.insert(scales.end(), 3, sizes[(i + i / 4) % 4]);
  add("tile borders", means, scales, random.uniform(20, 0.1, 0.9));
  std::vector<double> stack(60);
  for (size_t i = 0; i < 60; ++i) stack[i] = 1 + 3 * double(i) / 59;
  add("opaque stack", means_at(random, stack, 0.2), repeated({1}, 180), random.uniform(60, 0.3, 1));
  add("all behind", means_at(random, repeated({-2}, 5)), repeated({0.3}, 15), repeated({0.9}, 5));
  add("no Gaussian", {}, {}, {});

  add_scattered("quaternions of any length", 48, 33, 1, 2, 45);
  std::vector<double>& quaternions = scenes.back().quaternions;
  for (size_t k = 0; k < quaternions.size(); ++k) quaternions[k] *= std::exp2(25. * double(k / 4 % 9) - 100);

  // For each special value, 15 Gaussians that have it in one component each.
  const double infinity = std::numeric_limits<double>::infinity();
  const std::vector<double> special = {std::nan(""), infinity, -infinity, 0,     -1,   1e-45,
                                       1e-30,        1e30,     3e38,      -3e38, 1e18, 1e5};
  add_scattered("special values", 48, 33, 1, 2, 15 * special.size() + 4);
  Scene<double>& g = scenes.back();
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
  add_scattered("special values of cameras", 17, 9, 1, int(4 * special.size()), 6);
  for (size_t n = 0; n < 4 * special.size(); ++n) {
    double *const k = scenes.back().intrinsics.data() + 9 * n, *const pose = scenes.back().w2c.data() + 16 * n;
    double* const places[] = {k, k + 5, pose + 5, pose + 11};  // f_x, c_y, a diagonal element of the rotation, the depth of the origin
    *places[n % 4] = special[n / 4];
  }

  // A tile has more pairs than a GPU sorts in shared memory.
  add_scattered("a long list", 8, 8, 1, 1, 10000);

  // Every scene is antialiased with two of the four numbers of bases.
  for (size_t i = 0; i < scenes.size(); ++i) scenes[i].projection.antialiased = (i + size_t(bases)) % 2 == 1;
  // A third of those with a single basis function have colors instead.
  for (size_t i = 0; bases == 1 && i < scenes.size(); i += 3) scenes[i].projection.direct_colors = true;
  return scenes;
}

// Creates a scene with more Gaussians than are sorted and binned in one chunk.
inline Scene<double> many_gaussians(int bases) {
  Random random(8);
  return random_scene(random, "crowd", 20, 20, 1, 1, 66000, bases);
}

// Converts a scene to numbers of type T.
template <class T>
Scene<T> as(const Scene<double>& s) {
  return {s.name, s.width, s.height, s.bases, s.batch, s.cameras, converted<T>(s.means), converted<T>(s.scales), converted<T>(s.quaternions),
          converted<T>(s.opacities), converted<T>(s.sh), converted<T>(s.w2c), converted<T>(s.intrinsics), s.projection};
}

}  // namespace globalsplat::checks
