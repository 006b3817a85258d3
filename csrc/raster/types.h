// What the rasterizer reads and writes. Plain memory and numbers: no torch, no containers, so that a kernel file
// compiled for one instruction set shares nothing but these layouts with the others.
#pragma once

#include <cstdint>

namespace globalsplat::raster {

// Thresholds of the image formation model (the same for everybody, so they are no parameters).
inline constexpr double kNearPlane = 0.01;          // Gaussians with camera z at or below it are dropped
inline constexpr double kMinAlpha = 1.0 / 255.0;    // a smaller α contributes nothing
inline constexpr double kMaxAlpha = 0.999;          // α is capped here, and no gradient passes the cap
inline constexpr double kMinTransmittance = 1e-4;   // a Gaussian that would bring T to it or below ends the pixel
inline constexpr double kJacobianMargin = 0.15;     // share of the width (height) the clamp of J leaves on each side
inline constexpr double kMinDepthAlpha = 1e-10;     // expected depth is 0 where the accumulated opacity is not above
inline constexpr int kTile = 16;                    // tile edge in pixels

// One scene. Row-major arrays of `count` Gaussians.
template <class T>
struct Gaussians {
  const T* means;        // [N, 3] world
  const T* scales;       // [N, 3] linear
  const T* quaternions;  // [N, 4] (w, x, y, z), any length but zero
  const T* opacities;    // [N]
  const T* sh;           // [N, bases, 3]
  int64_t count;
  int bases;             // (degree + 1)²: 1, 4, 9 or 16
};

// Gradients with the layout of Gaussians; written, not added to.
template <class T>
struct GaussianGradients {
  T* means;
  T* scales;
  T* quaternions;
  T* opacities;
  T* sh;
};

// A pinhole camera: x_camera = rotation · x_world + translation, pixels by the intrinsics.
template <class T>
struct Camera {
  T rotation[9];  // row-major
  T translation[3];
  T fx, fy, cx, cy;
};

// A Gaussian seen by one camera: what blending needs, and nothing else.
template <class T>
struct Splat {
  T u, v;                 // 2D mean, pixels
  T a, b, c;              // σ = (aΔx + bΔy)² + (cΔy)²: a triangular factor of half the inverse 2D covariance. A sum of
                          // squares loses no digits on needles, where the terms of ½ΔᵀCΔ nearly cancel.
  T opacity;
  T red, green, blue;
  T z;                    // camera depth
  T max_power;            // σ above which α < 1/255, with a little room for rounding
  T half_height;          // |y − v| beyond it has σ > max_power
};

// An item of a tile's list: which splat, and where its gradient record goes.
struct TileEntry {
  uint32_t splat;
  uint32_t record;
};

// Sums over the pixels of one (splat, tile) pair; ν = ∂L/∂σ, and (p, r) = (aΔx + bΔy, cΔy) is the offset Δ measured in
// the splat's own widths, so that σ = p² + r² and nothing cancels on needles. With these ten numbers every gradient of
// the pair follows: see project.h.
template <class T>
struct SplatGradient {
  T power;                // Σ ν
  T power_p, power_r;     // Σ ν·(p, r)
  T power_pp, power_pr, power_rr;  // Σ ν·(p, r)(p, r)ᵀ
  T red, green, blue;     // Σ w·∂L/∂C
  T z;                    // Σ w·∂L/∂(Σ w z)

  SplatGradient& operator+=(const SplatGradient& other) {
    power += other.power;
    power_p += other.power_p;
    power_r += other.power_r;
    power_pp += other.power_pp;
    power_pr += other.power_pr;
    power_rr += other.power_rr;
    red += other.red;
    green += other.green;
    blue += other.blue;
    z += other.z;
    return *this;
  }
};

// One camera's pictures, planar: rgb is three planes of width × height. `Pixel` is T or const T.
template <class Pixel>
struct Pictures {
  Pixel* rgb;
  Pixel* alpha;
  Pixel* depth;
};

// One tile's work.
template <class T>
struct TileJob {
  const Splat<T>* splats;    // sorted front to back
  const TileEntry* entries;  // this tile's, front to back
  int64_t count;
  int x0, y0;                // the tile's first pixel
  int width, height;         // of the image
};

}  // namespace globalsplat::raster
