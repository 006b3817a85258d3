// Semi-global matching (Hirschmüller 2008): smooths the depths that a plane sweep finds. The cost of plane d at pixel p is C = 1 − score.
// It is added up along paths that run through the photo in eight directions r:
//
//   L(p, d) = C(p, d) + min(L(p − r, d), L(p − r, d ± 1) + P1, min_k L(p − r, k) + P2) − min_k L(p − r, k)
//
// L is C where a path begins. P2 is lower where the gray values of p and p − r differ, because depths jump mostly at edges. A pixel gets
// the plane with the least mean of L over all directions, M, and between planes the vertex of a parabola. It is as sure as 1 − M, times
// m / (m + 0.05), where m is the margin of M to the best plane that isn't adjacent.
#pragma once

#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// P1, the cost of a step to an adjacent plane, and P2, that of a larger step where gray values are equal.
inline constexpr float kStepCost = 0.1f, kJumpCost = 3;
// Rate at which P2 falls with the difference of gray values. It is P1 or more.
inline constexpr float kEdgeRate = 10;
// How much less the first plane, which is infinitely far, costs where a patch has no texture: it is usually the sky.
inline constexpr float kFarBonus = 0.1f;
// Margin at which a depth is half as sure as its cost says.
inline constexpr float kHalfMargin = 0.05f;
// Cost of the elements before the first plane and after the last, which no pixel chooses.
inline constexpr float kNoPlane = 1e6f;

using PathVector = Vector<float>;
inline constexpr int kPathLanes = Simd<float>::lanes;

// Costs L of a path, with kPathPadding elements before and after the planes, and their minimum.
struct PathCosts {
  float* planes;
  float* least;
};

// Costs of a path at consecutive pixels.
struct PathRow {
  float* planes;
  float* least;
  int64_t stride;

  PathCosts at(int pixel) const { return {planes + pixel * stride + kPathPadding, least + pixel}; }
};

GS_INLINE float smallest_lane(PathVector v) { return -largest_lane(-v); }

// Writes the costs of rows [begin, end). `scores` has those of all planes, [planes, H, sweep_stride(W)].
inline void costs_of_rows(const MatchedPhoto& photo, const float* scores, int begin, int end, float* costs) {
  const int64_t stride = plane_stride(photo.planes), row_stride = sweep_stride(photo.width), plane = row_stride * photo.height;
  for (int row = begin; row < end; ++row)
    for (int column = 0; column < photo.width; ++column) {
      float* const to = costs + (int64_t(row) * photo.width + column) * stride;
      const int64_t from = row * row_stride + column;
      for (int64_t d = 0; d < stride; ++d) to[d] = d < photo.planes ? 1 - scores[d * plane + from] : kNoPlane;
      to[0] -= kFarBonus * photo.least_variance / photo.variance[from];
    }
}

// Adds the costs along the four paths to each pixel that come from above and from the left, or from below and from the right if
// `backward`. Writes the sums of the four. `scratch` has path_scratch_size() elements.
inline void sum_paths(const MatchedPhoto& photo, const float* costs, bool backward, float* sums, float* scratch) {
  constexpr int paths = 4;  // from the column before, and from the three pixels nearby in the row before
  const int width = photo.width, height = photo.height;
  const int64_t stride = plane_stride(photo.planes);
  const auto take = [&](int64_t count) {
    float* const taken = scratch;
    scratch += count;
    return taken;
  };
  // Costs of the current row and of the row before, in turns, with one pixel outside at each end. All are 0 there, and before the first
  // row, so that a path begins.
  PathRow rows[2][paths];
  for (PathRow(&turn)[paths] : rows)
    for (PathRow& row : turn) {
      row.stride = stride + kPathPadding;
      row.planes = take((width + 2) * row.stride + kPathPadding);
      row.least = take(width + 2);
      for (int64_t i = 0; i < (width + 2) * row.stride + kPathPadding; ++i) row.planes[i] = 0;
      for (int i = 0; i < width + 2; ++i) {
        row.least[i] = 0;
        for (int k = 0; k < kPathPadding; ++k) row.planes[i * row.stride + k] = kNoPlane;
      }
      for (int k = 0; k < kPathPadding; ++k) row.planes[(width + 2) * row.stride + k] = kNoPlane;
    }
  const PathVector step_cost = broadcast<float>(kStepCost);
  for (int i = 0; i < height; ++i) {
    const int y = backward ? height - 1 - i : i;
    const PathRow(&above)[paths] = rows[(i + 1) % 2], (&here)[paths] = rows[i % 2];
    for (int j = 0; j < width; ++j) {
      const int x = backward ? width - 1 - j : j;
      const int64_t pixel = int64_t(y) * width + x;
      const int column[paths] = {j, j, j + 1, j + 2};  // of the pixel before, in the rows of costs
      PathCosts from[paths], to[paths];
      PathVector before[paths], jump[paths], least[paths];
      for (int k = 0; k < paths; ++k) {
        from[k] = (k == 0 ? here : above)[k].at(column[k]);
        to[k] = here[k].at(j + 1);
        const int dx = backward ? j + 1 - column[k] : column[k] - j - 1, dy = k == 0 ? 0 : backward ? 1 : -1;
        const bool begins = x + dx < 0 || x + dx >= width || y + dy < 0 || y + dy >= height;
        const float difference = begins ? 0 : __builtin_fabsf(photo.gray[pixel] - photo.gray[pixel + dy * width + dx]);
        const float cost = kJumpCost / (1 + kEdgeRate * difference);
        before[k] = broadcast<float>(*from[k].least);
        jump[k] = broadcast<float>(*from[k].least + (cost > kStepCost ? cost : kStepCost));
        least[k] = broadcast<float>(kNoPlane);
      }
      for (int64_t d = 0; d < stride; d += kPathLanes) {
        const PathVector cost = load<float>(costs + pixel * stride + d);
        PathVector sum{};
        for (int k = 0; k < paths; ++k) {
          const float* const p = from[k].planes + d;
          const PathVector stepped = smaller(load<float>(p - 1), load<float>(p + 1)) + step_cost;
          const PathVector total = cost + (smaller(smaller(load<float>(p), stepped), jump[k]) - before[k]);
          store<float>(to[k].planes + d, total);
          least[k] = smaller(least[k], total);
          sum = sum + total;
        }
        store<float>(sums + pixel * stride + d, sum);
      }
      for (int k = 0; k < paths; ++k) *to[k].least = smallest_lane(least[k]);
    }
  }
}

// Writes inverse depths and how sure they are, [H, W], of the rows [begin, end).
inline void choose_planes(const MatchedPhoto& photo, const PlaneCosts& costs, float step, int begin, int end, float* inverse_depth,
                          float* confidence) {
  const int64_t stride = plane_stride(photo.planes);
  const PathVector each = broadcast<float>(0.125f);
  for (int64_t pixel = int64_t(begin) * photo.width; pixel < int64_t(end) * photo.width; ++pixel) {
    float* const sums = costs.forward + pixel * stride;
    PathVector smallest = broadcast<float>(kNoPlane);
    for (int64_t d = 0; d < stride; d += kPathLanes) {
      const PathVector mean = (load<float>(sums + d) + load<float>(costs.backward + pixel * stride + d)) * each;
      store<float>(sums + d, mean);
      smallest = smaller(smallest, mean);
    }
    const float least = smallest_lane(smallest);
    int best = 0;
    while (sums[best] > least) ++best;
    float next = kNoPlane;
    for (int d = 0; d < photo.planes; ++d)
      if ((d < best - 1 || d > best + 1) && sums[d] < next) next = sums[d];
    float plane = float(best);
    if (best > 0 && best < photo.planes - 1) {
      const float before = sums[best - 1], after = sums[best + 1], curvature = before - 2 * least + after;
      if (curvature > 0) plane += 0.5f * (before - after) / curvature;
    }
    inverse_depth[pixel] = plane * step;
    const float margin = next - least, agreement = 1 - least;
    confidence[pixel] = (agreement < 0 ? 0 : agreement > 1 ? 1 : agreement) * margin / (margin + kHalfMargin);
  }
}

}  // namespace globalsplat::raster::GS_ISA
