// Plane sweep (Collins 1996) for the depths of a photo. On each of several planes parallel to the image, the other photos are warped onto
// it, and patches around each pixel are compared by their correlation:
//
//   (E[xy] − E[x] E[y]) / √((Var x + ε) (Var y + ε))
//
// ε is the least variance. The means E are over the pixels of the patch that are inside the photo, weighted by the product of both photos' weights. A pixel that
// another photo doesn't show, or that has too little weight, has the correlation −1 with it. The score of a plane at a pixel is the mean
// of the better half of its correlations, so that a pixel may be hidden in the other photos.
#pragma once

#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// Minimum product of the weights of two pixels that are compared.
inline constexpr float kLeastWeight = 0.5f;
// Minimum mean weight of a patch that is compared.
inline constexpr float kLeastMass = 0.25f;

using SweepVector = Vector<float>;
inline constexpr int kSweepLanes = Simd<float>::lanes;

// Values of a row whose means over patches are taken. The first three are unweighted if every pixel counts; the others are then unused.
enum Moment { kX, kXX, kXY, kW, kY, kYY, kMoments };

// One row: `padded` has each moment with zeros for the four columns before and after the row; `sums` has its sums over nine columns.
// `visible` is 1 where the other photo shows the pixel, and `weight` is the weight of the pixel.
struct SweepRow {
  float* sums[kMoments];
  float *visible, *weight;
};

// Buffers for the moments of one photo on one plane.
struct SweepBuffers {
  float* padded[kMoments];
  SweepRow rows[kPatch];
};

// Divides `memory` of sweep_buffers_size() elements among the buffers.
GS_INLINE SweepBuffers sweep_buffers(int width, float* memory) {
  const int64_t stride = sweep_stride(width);
  const auto take = [&](int64_t count) {
    float* const taken = memory;
    memory += count;
    return taken;
  };
  SweepBuffers buffers;
  for (float*& padded : buffers.padded) {
    padded = take(stride + 32);
    for (int i = 0; i < stride + 32; ++i) padded[i] = 0;
  }
  for (SweepRow& row : buffers.rows) {
    for (float*& sums : row.sums) sums = take(stride);
    row.visible = take(stride);
    row.weight = take(stride);
  }
  return buffers;
}

GS_INLINE SweepVector interpolate(const float* image, int width, Simd<float>::bits corner, SweepVector right, SweepVector down) {
  const SweepVector a = gather(image, corner), b = gather(image, corner + 1);
  const SweepVector c = gather(image, corner + width), d = gather(image, corner + width + 1);
  const SweepVector above = add_product(right, b - a, a), below = add_product(right, d - c, c);
  return add_product(down, below - above, above);
}

// Warps a row of `other` onto the plane of the given inverse depth, and computes the row's moments.
template <bool weighted>
GS_INLINE void warp_row(const SweepPhoto& own, const ComparedPhoto& other, float inverse_depth, int row, const SweepBuffers& buffers,
                        const SweepRow& to) {
  const float* const m = other.to_pixels;
  const auto vector = [](float value) { return broadcast<float>(value); };
  const int width = own.width;
  SweepVector step, start[3];
  for (int lane = 0; lane < kSweepLanes; ++lane) step[lane] = float(lane) + 0.5f;
  for (int k = 0; k < 3; ++k) start[k] = vector(m[4 * k + 1] * (float(row) + 0.5f) + m[4 * k + 2] + m[4 * k + 3] * inverse_depth);
  const SweepVector right = vector(float(other.photo.width)), bottom = vector(float(other.photo.height));
  for (int i = 0; i < width; i += kSweepLanes) {
    const SweepVector column = step + vector(float(i));
    SweepVector at[3];
    for (int k = 0; k < 3; ++k) at[k] = add_product(vector(m[4 * k]), column, start[k]);
    const SweepVector x = at[0] / at[2], y = at[1] / at[2];
    const Mask<float> shown = both(both(both(less_equal(SweepVector{}, x), less_equal(x, right)),
                                        both(less_equal(SweepVector{}, y), less_equal(y, bottom))),
                                   less(SweepVector{}, at[2]));
    // Beyond the centers of the pixels at the border, the values there are repeated.
    const SweepVector half = vector(0.5f), one = vector(1);
    const SweepVector px = clamp(x - half, SweepVector{}, right - one), py = clamp(y - half, SweepVector{}, bottom - one);
    using Integers = Simd<float>::bits;
    const Integers left = __builtin_convertvector(smaller(px, right - one - one), Integers);
    const Integers top = __builtin_convertvector(smaller(py, bottom - one - one), Integers);
    const SweepVector fx = px - __builtin_convertvector(left, SweepVector), fy = py - __builtin_convertvector(top, SweepVector);
    const Integers corner = top * other.photo.width + left;
    const SweepVector inside = select(less(column, vector(float(width))), one, SweepVector{});
    const SweepVector value = interpolate(other.photo.gray, other.photo.width, corner, fx, fy) * inside;
    const int64_t at_row = int64_t(row) * width + i;
    const SweepVector mine = load_partial<float>(own.gray + at_row, width - i);
    store<float>(to.visible + i, select(shown, one, SweepVector{}));
    const auto put = [&](Moment moment, SweepVector v) { store<float>(buffers.padded[moment] + kPatch / 2 + i, v); };
    if constexpr (weighted) {
      SweepVector weight = inside;
      if (own.weight != nullptr) weight = weight * load_partial<float>(own.weight + at_row, width - i);
      if (other.photo.weight != nullptr) weight = weight * interpolate(other.photo.weight, other.photo.width, corner, fx, fy);
      store<float>(to.weight + i, weight);
      const SweepVector wx = weight * value, wy = weight * mine;
      put(kX, wx), put(kXX, wx * value), put(kXY, wx * mine), put(kW, weight), put(kY, wy), put(kYY, wy * mine);
    } else {
      put(kX, value), put(kXX, value * value), put(kXY, value * mine);
    }
  }
}

// Sums each moment over the nine columns around every pixel of a row.
GS_INLINE void sum_columns(const SweepBuffers& buffers, int moments, int width, const SweepRow& to) {
  for (int moment = 0; moment < moments; ++moment)
    for (int i = 0; i < width; i += kSweepLanes) {
      const float* const from = buffers.padded[moment] + i;
      SweepVector sum = load<float>(from);
      for (int k = 1; k < kPatch; ++k) sum = sum + load<float>(from + k);
      store<float>(to.sums[moment] + i, sum);
    }
}

// Returns the number of pixels along one side of the patch around pixel `i` that are inside a side of `length` pixels.
GS_INLINE int patch_length(int i, int length) {
  const int before = i < kPatch / 2 ? i : kPatch / 2, after = length - 1 - i;
  return before + 1 + (after < kPatch / 2 ? after : kPatch / 2);
}

// Mean and variance of the photo itself, [H, stride] each, and the inverse number of columns of the patch around each column, [stride].
struct OwnMoments {
  float *mean, *variance, *each_column;
};

// Sums moment `moment` over the rows around row `row`, at columns i and following.
GS_INLINE SweepVector sum_rows(const SweepBuffers& buffers, Moment moment, int first, int last, int i) {
  SweepVector sum{};
  for (int row = first; row <= last; ++row) sum = sum + load<float>(buffers.rows[row % kPatch].sums[moment] + i);
  return sum;
}

// Calls row_done(row, first, last) for each row once the sums of the rows around it, first to last, are in the buffers.
template <class FillRow, class RowDone>
GS_INLINE void stream_rows(int height, const FillRow& fill_row, const RowDone& row_done) {
  constexpr int reach = kPatch / 2;
  for (int next = 0; next < height + reach; ++next) {
    if (next < height) fill_row(next);
    const int row = next - reach;
    if (row < 0) continue;
    row_done(row, row > reach ? row - reach : 0, next < height ? next : height - 1);
  }
}

GS_INLINE void compute_own_moments(const SweepPhoto& own, float least_variance, const SweepBuffers& buffers, const OwnMoments& to) {
  const int64_t stride = sweep_stride(own.width);
  for (int i = 0; i < stride; ++i) to.each_column[i] = i < own.width ? 1.0f / float(patch_length(i, own.width)) : 0;
  const auto fill_row = [&](int row) {
    for (int i = 0; i < own.width; i += kSweepLanes) {
      const SweepVector value = load_partial<float>(own.gray + int64_t(row) * own.width + i, own.width - i);
      store<float>(buffers.padded[kX] + kPatch / 2 + i, value);
      store<float>(buffers.padded[kXX] + kPatch / 2 + i, value * value);
    }
    sum_columns(buffers, 2, own.width, buffers.rows[row % kPatch]);
  };
  stream_rows(own.height, fill_row, [&](int row, int first, int last) {
    const SweepVector each_row = broadcast<float>(1.0f / float(last - first + 1));
    for (int i = 0; i < own.width; i += kSweepLanes) {
      const SweepVector scale = load<float>(to.each_column + i) * each_row;
      const SweepVector mean = sum_rows(buffers, kX, first, last, i) * scale;
      store<float>(to.mean + row * stride + i, mean);
      store<float>(to.variance + row * stride + i,
                   subtract_product(mean, mean, sum_rows(buffers, kXX, first, last, i) * scale) + broadcast<float>(least_variance));
    }
  });
}

// Inserts the correlations of `other` on a plane into the best `votes` of each pixel, [votes, H, stride], in descending order.
template <bool weighted>
GS_INLINE void correlate(const SweepPhoto& own, const ComparedPhoto& other, float inverse_depth, float least_variance,
                         const OwnMoments& own_moments, const SweepBuffers& buffers, int votes, float* best) {
  const int64_t stride = sweep_stride(own.width), plane = stride * own.height;
  const auto vector = [](float value) { return broadcast<float>(value); };
  const auto fill_row = [&](int row) {
    const SweepRow& to = buffers.rows[row % kPatch];
    warp_row<weighted>(own, other, inverse_depth, row, buffers, to);
    sum_columns(buffers, weighted ? kMoments : kW, own.width, to);
  };
  stream_rows(own.height, fill_row, [&](int row, int first, int last) {
    const SweepRow& here = buffers.rows[row % kPatch];
    const SweepVector each_row = vector(1.0f / float(last - first + 1));
    for (int i = 0; i < own.width; i += kSweepLanes) {
      const auto sum = [&](Moment moment) { return sum_rows(buffers, moment, first, last, i); };
      SweepVector scale = load<float>(own_moments.each_column + i) * each_row;
      Mask<float> counts = less(SweepVector{}, load<float>(here.visible + i));
      SweepVector own_mean, own_variance;
      if constexpr (weighted) {
        const SweepVector mass = sum(kW) * scale;
        counts = both(counts, both(less_equal(vector(kLeastWeight), load<float>(here.weight + i)), less_equal(vector(kLeastMass), mass)));
        scale = scale / larger(mass, vector(kLeastMass));
        own_mean = sum(kY) * scale;
        own_variance = subtract_product(own_mean, own_mean, sum(kYY) * scale) + vector(least_variance);
      } else {
        own_mean = load<float>(own_moments.mean + row * stride + i);
        own_variance = load<float>(own_moments.variance + row * stride + i);
      }
      const SweepVector mean = sum(kX) * scale;
      const SweepVector variance = subtract_product(mean, mean, sum(kXX) * scale) + vector(least_variance);
      const SweepVector covariance = subtract_product(mean, own_mean, sum(kXY) * scale);
      SweepVector correlation = select(counts, covariance / sqrt(variance * own_variance), vector(-1));
      for (int vote = 0; vote < votes; ++vote) {
        float* const to = best + vote * plane + row * stride + i;
        const SweepVector held = load<float>(to);
        store<float>(to, larger(held, correlation));
        correlation = smaller(held, correlation);
      }
    }
  });
}

// Computes the scores of the planes [begin, end), [end − begin, H, stride]. `scratch` has sweep_scratch_size() elements.
inline void sweep_planes(const PlaneSweep& sweep, int begin, int end, float* scores, float* scratch) {
  const SweepPhoto& own = sweep.own;
  const int64_t stride = sweep_stride(own.width), plane = stride * own.height;
  const int votes = sweep_votes(sweep.count);
  const auto take = [&](int64_t count) {
    float* const taken = scratch;
    scratch += count;
    return taken;
  };
  const OwnMoments own_moments{take(plane), take(plane), take(stride)};
  float* const best = take(votes * plane);
  const SweepBuffers buffers = sweep_buffers(own.width, scratch);
  compute_own_moments(own, sweep.least_variance, buffers, own_moments);
  for (int index = begin; index < end; ++index) {
    for (int64_t i = 0; i < votes * plane; ++i) best[i] = sweep.least_correlation;
    for (int k = 0; k < sweep.count; ++k) {
      const ComparedPhoto& other = sweep.others[k];
      const float inverse_depth = float(index) * sweep.step;
      if (own.weight != nullptr || other.photo.weight != nullptr)
        correlate<true>(own, other, inverse_depth, sweep.least_variance, own_moments, buffers, votes, best);
      else
        correlate<false>(own, other, inverse_depth, sweep.least_variance, own_moments, buffers, votes, best);
    }
    const SweepVector each = broadcast<float>(1.0f / float(votes));
    float* const to = scores + (index - begin) * plane;
    for (int64_t i = 0; i < plane; i += kSweepLanes) {
      SweepVector sum = load<float>(best + i);
      for (int vote = 1; vote < votes; ++vote) sum = sum + load<float>(best + vote * plane + i);
      store<float>(to + i, sum * each);
    }
  }
}

// Writes the variance of the patch around each pixel plus the least variance, [H, stride]. `scratch` has variance_scratch_size() elements.
inline void patch_variances(const SweepPhoto& photo, float least_variance, float* variance, float* scratch) {
  const int64_t stride = sweep_stride(photo.width), plane = stride * photo.height;
  const SweepBuffers buffers = sweep_buffers(photo.width, scratch + plane + stride);
  compute_own_moments(photo, least_variance, buffers, {scratch, variance, scratch + plane});
}

}  // namespace globalsplat::raster::GS_ISA
