// Inputs and outputs of the rasterizer: plain memory and numbers, without torch and containers, so that a kernel file compiled for one
// instruction set shares nothing but these layouts with the others.
#pragma once

#include <cstdint>

namespace globalsplat::raster {

// Constants of the image formation model. ProjectionSettings has those that callers may change.
inline constexpr double kMinAlpha = 1.0 / 255.0;    // smaller values of α contribute nothing
inline constexpr double kMaxAlpha = 0.999;          // maximum of α; no gradient passes the cap
inline constexpr double kMinTransmittance = 1e-4;   // a Gaussian that would reduce T to this or less ends the pixel
inline constexpr double kJacobianMargin = 0.15;     // margin of the clamp of J, relative to width (height), on each side
inline constexpr double kMinDepthAlpha = 1e-10;     // expected depth is 0 unless the accumulated opacity exceeds this
inline constexpr double kLog2E = 1.4426950408889634;
inline constexpr double kLog2Of255 = 7.994353436858858;
// Coefficients of 2^f in ascending powers of f, with an error of 2.6e-8 for |f| ≤ 1/16 (Remez).
inline constexpr float kExp2[4] = {1.0f, 0.69314721f, 0.24025763f, 0.05549622f};
// Bits of 2^(i/8) minus i·2²⁰. Adding the bits of x + kToEighths = 1.5·2²⁰ + x, shifted left by 20, restores the subtracted term.
inline constexpr float kToEighths = 1572864.0f;
inline constexpr uint32_t kExp2Eighths[8] = {0x3f800000, 0x3f7b95c2, 0x3f7837f0, 0x3f75fed7,
                                             0x3f7504f3, 0x3f75672a, 0x3f7744fd, 0x3f7ac0c7};
inline constexpr int kTile = 16;                    // tile edge in pixels
inline constexpr int kBlock = 4;                    // edge in pixels of the blocks in which a tile is culled and blended
inline constexpr int kSplatsPerTask = 512;          // maximum number of splats per call that lists tiles
inline constexpr int kBlocks = 16;                  // blocks per tile

// Gaussians of one scene, or of several scenes one after the other, with `count` Gaussians each. Row-major.
template <class T>
struct Gaussians {
  const T* means;        // [N, 3] world
  const T* scales;       // [N, 3] linear
  const T* quaternions;  // [N, 4] (w, x, y, z), any length except 0, for which they are dropped
  const T* opacities;    // [N]
  const T* sh;           // [N, bases, 3]
  int64_t count;
  int bases;             // (degree + 1)²: 1, 4, 9 or 16

  Gaussians of_scene(int64_t scene) const {
    const int64_t first = scene * count;
    return {means + 3 * first, scales + 3 * first, quaternions + 4 * first, opacities + first, sh + 3 * bases * first, count, bases};
  }
};

// Gradients with the layout of Gaussians; overwritten, not accumulated.
template <class T>
struct GaussianGradients {
  T* means;
  T* scales;
  T* quaternions;
  T* opacities;
  T* sh;
  T* means2d;  // [cameras of the scene, N, 2], of the projected means; null if not requested

  // Returns the gradients of a scene of `all`, without means2d.
  GaussianGradients of_scene(const Gaussians<T>& all, int64_t scene) const {
    const int64_t first = scene * all.count;
    return {means + 3 * first, scales + 3 * first, quaternions + 4 * first, opacities + first, sh + 3 * all.bases * first, nullptr};
  }
};

// Gradient with respect to a camera's pose: of the nine entries of `rotation`, treated as independent, then of `translation`.
inline constexpr int kCameraNumbers = 12;
template <class T>
struct CameraGradient {
  T numbers[kCameraNumbers];
};

// Settings of the projection that all cameras of a call share.
struct ProjectionSettings {
  double eps2d = 0;           // added to the diagonal of every 2D covariance, pixels²
  bool antialiased = false;   // whether opacities are reduced by what eps2d adds to the splats' areas
  bool direct_colors = false;  // whether `sh` holds colors [N, 1, 3] that are used as they are, instead of harmonics
  double near_plane = 0.01;   // Gaussians whose camera-space z is not between near_plane and far_plane are dropped
  double far_plane = 1e10;
};

// Pinhole camera: x_camera = rotation · x_world + translation, then pixels by the intrinsics.
template <class T>
struct Camera {
  T rotation[9];  // row-major
  T translation[3];
  T fx, fy, cx, cy;
};

// Camera with precomputed values that all of its Gaussians share.
template <class T>
struct ProjectionParams {
  Camera<T> camera;
  int width, height;
  T eps2d, near_plane, far_plane;  // as in ProjectionSettings
  bool antialiased, direct_colors;
  T center[3];                     // world
  T x_low, x_high, y_low, y_high;  // clamp range of x/z and y/z for the Jacobian
};

// A Gaussian projected into one camera. Exponents have base 2: α = min(0.999, 2^(log2_opacity − s)), where s = (aΔx + bΔy)² + (cΔy)² and Δ
// = mean − pixel center. A sum of squares loses no digits on needles, for which the terms of the usual quadratic form nearly cancel. 16
// values: in float32 one cache line.
template <class T>
struct alignas(64) Splat {
  T u, v;                     // 2D mean, pixels
  T a, b, c;                  // √½·log₂e times the inverse 2D covariance's Cholesky factor [[a, b], [0, c]]
  T log2_opacity;
  T red, green, blue;
  T z;                        // camera-space depth; 0 if not visible
  T reach;                    // s above which α < 1/255, with a margin for rounding
  T half_width, half_height;  // larger |Δx| or |Δy| have s > reach
  T slope_x, slope_y;         // s is minimal at Δx = −slope_x·Δy for a given Δy, and at Δy = −slope_y·Δx for a given Δx
  T unused;
};

// A (splat, tile) pair. Bit 4·j + i of `blocks` is set if the splat touches the tile's block in column i and row j.
struct TilePair {
  uint32_t tile;
  uint32_t blocks;
};

// Grid of the tiles of an image.
struct Grid {
  int width, height;  // of the image, pixels
  int columns, rows;  // of tiles
  int tiles() const { return columns * rows; }
};

// Item of a tile's list: the index of the splat, the index of its gradient record, and the blocks of the tile that it touches.
struct TileEntry {
  uint32_t splat;
  uint32_t record;
  uint32_t blocks;
};

// Sums over the pixels of one (splat, tile) pair; ν = −α ∂L/∂α, and (p, r) = (aΔx + bΔy, cΔy) is the offset Δ in units of the splat's
// widths. Every gradient of the pair follows from these ten values: see project.h.
template <class T>
struct SplatGradient {
  T power;                // Σ ν
  T power_p, power_r;     // Σ ν·(p, r)
  T power_pp, power_pr, power_rr;  // Σ ν·(p, r)(p, r)ᵀ
  T red, green, blue;     // Σ w·∂L/∂C
  T z;                    // Σ w·∂L/∂(Σ w z)
};
inline constexpr int kSplatGradientNumbers = 10;

// Gradient records of one camera: those of Gaussian i are records[first[i]] … records[first[i + 1] − 1].
template <class T>
struct SplatRecords {
  const SplatGradient<T>* records;
  const uint32_t* first;  // [N + 1]
};

// Images of one camera, or of several one after the other. They are planar: rgb is three planes of width × height. `Pixel` is T or const T.
template <class Pixel>
struct RenderOutput {
  Pixel* rgb;
  Pixel* alpha;
  Pixel* depth;

  // Returns the images of a camera, given the number of pixels of an image.
  RenderOutput of_view(int64_t view, int64_t pixels) const {
    return {rgb + 3 * pixels * view, alpha + pixels * view, depth + pixels * view};
  }
};

// Inputs of a call: scenes with several cameras each. Arrays of all scenes, or of all cameras of all scenes, are one after the other.
template <class T>
struct Arguments {
  Gaussians<T> gaussians;   // of all B scenes; `count` is the number per scene
  const T* w2c;             // [B, C, 4, 4]
  const T* intrinsics;      // [B, C, 3, 3], pixels
  int64_t scenes, cameras;  // B, and C cameras per scene
  int width, height;
  ProjectionSettings projection;
};

// Numbers of (pixel, splat) pairs and of (tile, splat) pairs.
struct PairCounts {
  int64_t tile_entries = 0;
  int64_t evaluated = 0;     // pairs whose α is computed
  int64_t contributing = 0;  // pairs that are blended
};

// Job that blends one tile.
template <class T>
struct TileJob {
  const Splat<T>* splats;    // of this tile, front to back
  const TileEntry* entries;  // this tile's, front to back
  int64_t count;
  int x0, y0;                // the tile's first pixel
  int width, height;         // of the image
};

// Constants of SSIM: side of the window in pixels, (0.01 L)² and (0.03 L)² for the data range L = 1, and the factor for sample variances.
inline constexpr int kWindow = 11;
inline constexpr double kSsimC1 = 1e-4, kSsimC2 = 9e-4;
inline constexpr double kSsimSample = 121.0 / 120.0;

// One channel of an image and of the photo, with buffers for its gradient. Row-major.
template <class T>
struct PhotometricPlane {
  const T* picture;  // [H, W]
  const T* photo;    // [H, W]
  T* slopes;         // [3, H − 10, W − 10], derivatives of each window's SSIM by its means of x, x² and xy; null if not requested
  T* gradient;       // [H, W]
  const T* weights;  // [11], weights of the window in each direction
  int width, height;
};

// Rate at which a difference of the photo's gray values reduces the weight of a difference of depths; see unevenness.h.
inline constexpr double kEdge = 10;

// Depths of an image, with its photo and a buffer for the gradient; see smoothness.h. Row-major.
template <class T>
struct SmoothnessPlane {
  const T* depth;  // [H, W]
  const T* photo;  // [3, H, W]
  T* gradient;     // [H, W]; null if not requested
  int width, height;
};

// Images of a loss, `count` planes [H, W], and the photos that it compares them with.
template <class T>
struct LossJob {
  const T* images;
  const T* photos;
  int64_t count;
  int width, height;
};

// Returns the number of elements of scratch memory that a kernel needs for rows of this width.
inline constexpr int loss_scratch_size(int width) { return 6 * (width + 33); }

// Gray values of a photo whose depths are searched, or that is compared with it, and weights of its pixels; see plane_sweep.h. Row-major.
struct SweepPhoto {
  const float* gray;    // [H, W], both sides at least 9
  const float* weight;  // [H, W], null if every pixel counts
  int width, height;
};

// Photo that is compared. `to_pixels`, [3, 4], maps (column, row, 1, inverse depth) of the photo whose depths are searched to
// (column · z, row · z, z) of this one. Coordinates are continuous: the center of the first pixel is at ½.
struct ComparedPhoto {
  SweepPhoto photo;
  float to_pixels[12];
};

// Search for the inverse depths of the pixels of `own`, among multiples of `step`.
struct PlaneSweep {
  SweepPhoto own;
  const ComparedPhoto* others;
  int count;  // of the others, at least 1
  float step;
  float least_variance;     // added to variances, so that noise doesn't correlate
  float least_correlation;  // all lower ones count as this
};

// Side in pixels of the patches that are compared.
inline constexpr int kPatch = 9;

// Returns the stride between rows of a photo of this width, a multiple of every instruction set's vectors.
inline constexpr int64_t sweep_stride(int width) { return (width + 15) / 16 * 16; }

// Returns the number of photos, of those compared, whose correlations are averaged.
inline constexpr int sweep_votes(int count) { return count < 2 ? 1 : count / 2; }

// Returns the number of elements of the buffers for the moments of a photo on a plane.
inline constexpr int64_t sweep_buffers_size(int width) { return sweep_stride(width) * (kPatch * 8 + 6) + 6 * 32; }

// Returns the number of elements of scratch memory that the search needs.
inline constexpr int64_t sweep_scratch_size(const PlaneSweep& sweep) {
  const int64_t stride = sweep_stride(sweep.own.width);
  return stride * (sweep.own.height * (2 + sweep_votes(sweep.count)) + 1) + sweep_buffers_size(sweep.own.width);
}

// Photo whose pixels choose among `planes` planes by semi-global matching; see semi_global.h.
struct MatchedPhoto {
  const float* gray;      // [H, W]
  const float* variance;  // of the patches and least_variance, [H, sweep_stride(W)]
  float least_variance;
  int width, height, planes;
};

// Costs of all planes at each pixel, and their sums along the paths of either half of the directions, [H, W, plane_stride(planes)] each.
struct PlaneCosts {
  float *own, *forward, *backward;
};

// Number of elements between the costs of two pixels of a path: a vector of every instruction set.
inline constexpr int kPathPadding = 16;

// Returns the stride between the costs of two pixels, a multiple of every instruction set's vectors.
inline constexpr int64_t plane_stride(int planes) { return (planes + 15) / 16 * 16; }

// Returns the number of elements of scratch memory for sums along paths.
inline constexpr int64_t path_scratch_size(const MatchedPhoto& photo) {
  return 8 * ((photo.width + 2) * (plane_stride(photo.planes) + kPathPadding + 1) + kPathPadding);
}

// Returns the number of elements of scratch memory for the variances of patches.
inline constexpr int64_t variance_scratch_size(const SweepPhoto& photo) {
  const int64_t stride = sweep_stride(photo.width);
  return stride * (photo.height + 1) + sweep_buffers_size(photo.width);
}

// Parameters of a step of Adam that all elements share; see optim.h.
struct AdamStep {
  double step_size, bias_correction2_sqrt, decay;
  double beta1, beta2, epsilon;
};

// Values, their gradients and their moments.
template <class T>
struct AdamState {
  T* value;
  const T* gradient;
  T* first;
  T* second;
};

// Parameters of a step of Muon that all matrices share; and a matrix, its gradient and the gradient's running mean; see optim.h. Row-major.
struct MuonStep {
  double rate, decay, beta;
};
struct MuonMatrix {
  float* value;
  const float* gradient;
  float* first;
  int64_t rows, columns;
};

// Returns the stride between rows of the matrix, transposed if that has fewer rows, and of its products with itself. It avoids powers of
// two, for which rows would compete for few cache lines.
inline constexpr int64_t muon_stride(int64_t columns) { return (columns + 63) / 64 * 64 + 16; }

// Returns the number of elements of scratch memory that a step of Muon needs for a matrix.
inline constexpr int64_t muon_scratch_size(int64_t rows, int64_t columns) {
  const int64_t few = rows < columns ? rows : columns, many = rows < columns ? columns : rows;
  return (2 * (few + 6) + muon_stride(few)) * muon_stride(many) + 3 * (few + 6) * muon_stride(few);
}

}  // namespace globalsplat::raster
