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
inline constexpr double kLog2E = 1.4426950408889634;
inline constexpr double kLog2Of255 = 7.994353436858858;
// 2^f for |f| ≤ 1/16 to 2.6e-8 (Remez), by powers of f.
inline constexpr float kExp2[4] = {1.0f, 0.69314721f, 0.24025763f, 0.05549622f};
// The bits of 2^(i/8) less i·2²⁰, which adding x + kToEighths = 1.5·2²⁰ + x, shifted left by 20 bits, gives back.
inline constexpr float kToEighths = 1572864.0f;
inline constexpr uint32_t kExp2Eighths[8] = {0x3f800000, 0x3f7b95c2, 0x3f7837f0, 0x3f75fed7,
                                             0x3f7504f3, 0x3f75672a, 0x3f7744fd, 0x3f7ac0c7};
inline constexpr int kTile = 16;                    // tile edge in pixels
inline constexpr int kBlock = 4;                    // edge in pixels of the blocks that a tile is culled and blended by
inline constexpr int kCoverTask = 512;              // splats whose tiles are listed in one go
inline constexpr int kBlocks = 16;                  // of a tile

// One scene. Row-major arrays of `count` Gaussians.
template <class T>
struct Gaussians {
  const T* means;        // [N, 3] world
  const T* scales;       // [N, 3] linear
  const T* quaternions;  // [N, 4] (w, x, y, z), any length; of length 0 they are dropped
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

// The gradient with respect to a camera's pose: of the nine numbers of `rotation`, taken as free, then of `translation`.
inline constexpr int kCameraNumbers = 12;
template <class T>
struct CameraGradient {
  T numbers[kCameraNumbers];
};

// A pinhole camera: x_camera = rotation · x_world + translation, pixels by the intrinsics.
template <class T>
struct Camera {
  T rotation[9];  // row-major
  T translation[3];
  T fx, fy, cx, cy;
};

// A camera with what all of its Gaussians share.
template <class T>
struct Lens {
  Camera<T> camera;
  int width, height;
  T eps2d;                         // added to the diagonal of every 2D covariance, pixels²
  T centre[3];                     // world
  T x_low, x_high, y_low, y_high;  // what x/z and y/z are clamped to for the Jacobian
};

// A Gaussian seen by one camera. Exponents are to base 2: α = min(0.999, 2^(log2_opacity − s)), where
// s = (aΔx + bΔy)² + (cΔy)² and Δ = mean − pixel centre. A sum of squares loses no digits on needles, where the terms of
// the usual quadratic form nearly cancel. 16 numbers: in float32 a cache line.
template <class T>
struct alignas(64) Splat {
  T u, v;                     // 2D mean, pixels
  T a, b, c;                  // √½·log₂e times the inverse 2D covariance's Cholesky factor [[a, b], [0, c]]
  T log2_opacity;
  T red, green, blue;
  T z;                        // camera depth; 0: not seen
  T reach;                    // s above which α < 1/255, with a little room for rounding
  T half_width, half_height;  // |Δx| or |Δy| beyond them has s > reach
  T slope_x, slope_y;         // s is least at Δx = −slope_x·Δy for a given Δy, and at Δy = −slope_y·Δx for a given Δx
  T unused;
};

// A splat that touches a tile. Bit 4·j + i of `blocks` says that it touches the tile's block in column i and row j.
struct TilePair {
  uint32_t tile;
  uint32_t blocks;
};

// The tiles of a picture.
struct Grid {
  int width, height;  // of the picture, pixels
  int columns, rows;  // of tiles
  int tiles() const { return columns * rows; }
};

// An item of a tile's list: which splat, where its gradient record goes, which of the tile's blocks it touches.
struct TileEntry {
  uint32_t splat;
  uint32_t record;
  uint32_t blocks;
};

// Sums over the pixels of one (splat, tile) pair; ν = −α ∂L/∂α, and (p, r) = (aΔx + bΔy, cΔy) is the offset Δ measured
// in the splat's own widths. With these ten numbers every gradient of the pair follows: see project.h.
template <class T>
struct SplatGradient {
  T power;                // Σ ν
  T power_p, power_r;     // Σ ν·(p, r)
  T power_pp, power_pr, power_rr;  // Σ ν·(p, r)(p, r)ᵀ
  T red, green, blue;     // Σ w·∂L/∂C
  T z;                    // Σ w·∂L/∂(Σ w z)
};
inline constexpr int kSplatGradientNumbers = 10;

// One camera's records: those of Gaussian i are records[first[i]] … records[first[i + 1] − 1].
template <class T>
struct SplatRecords {
  const SplatGradient<T>* records;
  const uint32_t* first;  // [N + 1]
};

// One camera's pictures, planar: rgb is three planes of width × height. `Pixel` is T or const T.
template <class Pixel>
struct Pictures {
  Pixel* rgb;
  Pixel* alpha;
  Pixel* depth;
};

// (pixel, splat) pairs, and (tile, splat) pairs.
struct PairCounts {
  int64_t tile_entries = 0;
  int64_t evaluated = 0;     // α was computed
  int64_t contributing = 0;  // and the splat was blended
};

// One tile's work.
template <class T>
struct TileJob {
  const Splat<T>* splats;    // by Gaussian
  const TileEntry* entries;  // this tile's, front to back
  int64_t count;
  int x0, y0;                // the tile's first pixel
  int width, height;         // of the picture
};

// SSIM: its window's side in pixels, (0.01 L)² and (0.03 L)² for the data range L = 1, and what makes sample variances.
inline constexpr int kWindow = 11;
inline constexpr double kSsimC1 = 1e-4, kSsimC2 = 9e-4;
inline constexpr double kSsimSample = 121.0 / 120.0;

// One channel of a picture, the photo's, and what its gradient is made of. Row-major.
template <class T>
struct FitPlane {
  const T* picture;  // [H, W]
  const T* photo;    // [H, W]
  T* slopes;         // [3, H − 10, W − 10] of every window's SSIM to its means of x, x² and xy; null: not asked for
  T* gradient;       // [H, W]
  const T* weights;  // [11] of the window, in each direction
  int width, height;
};

// By how much a step in the photo's grey excuses one in depth, and a picture's depths with its photo and what their gradient goes
// to; see smooth.h. Row-major.
inline constexpr double kEdge = 10;
template <class T>
struct DepthPlane {
  const T* depth;  // [H, W]
  const T* photo;  // [3, H, W]
  T* gradient;     // [H, W]; null: not asked for
  int width, height;
};

// The depths of several pictures, [views, H, W], and the photos, [views, 3, H, W].
template <class T>
struct DepthJob {
  const T* depths;
  const T* photos;
  int64_t views;
  int width, height;
};

// Numbers that a kernel for rows of this width works with.
inline constexpr int fit_room(int width) { return 6 * (width + 33); }

// What all numbers of one step of Adam share; see adam.h.
struct AdamStep {
  double rate, root, decay;
  double beta1, beta2, epsilon;
};

// The numbers, their gradients and their moments.
template <class T>
struct AdamNumbers {
  T* value;
  const T* gradient;
  T* first;
  T* second;
};

// What all matrices of one step of Muon share, and a matrix, its gradient and the running mean of that; see muon.h. Row-major.
struct MuonStep {
  double rate, decay, beta;
};
struct MuonMatrix {
  float* value;
  const float* gradient;
  float* first;
  int64_t rows, columns;
};

// Of the matrix with as few rows as possible: numbers from one row to the next, of itself and of its products with itself. Rows that
// are a power of two apart would share few lines of the caches.
inline constexpr int64_t muon_stride(int64_t columns) { return (columns + 63) / 64 * 64 + 16; }

// Numbers that a step of a matrix works with.
inline constexpr int64_t muon_room(int64_t rows, int64_t columns) {
  const int64_t few = rows < columns ? rows : columns, many = rows < columns ? columns : rows;
  return (2 * (few + 6) + muon_stride(few)) * muon_stride(many) + 3 * (few + 6) * muon_stride(few);
}

}  // namespace globalsplat::raster
