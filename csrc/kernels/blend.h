// Alpha blending of one 16×16 tile, forward and backward: the order in which splats and pixels are combined; pixel.h has the maths.
//
// The unit of work is a block of 4×4 pixels, which is one vector on AVX-512 and several elsewhere: splats are small and round rather than
// elongated, so they fill a square better than a row.
#pragma once

#include "pixel.h"
#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// Number of vectors per block: vector k holds its pixels k·lanes … (k + 1)·lanes − 1, in row-major order.
template <class T>
inline constexpr int kVectors = kBlock * kBlock / Simd<T>::lanes;

// Centers of the pixels in every vector of a block whose first pixel is (0, 0).
template <class T>
struct Centers {
  T x[16], y[16];
  constexpr Centers() : x{}, y{} {
    for (int i = 0; i < 16; ++i) {
      x[i] = T(i % kBlock) + T(0.5);
      y[i] = T(i / kBlock) + T(0.5);
    }
  }
};
template <class T>
inline constexpr Centers<T> kCenters{};

// Number of items by which prefetching runs ahead. A tile's splats and records are scattered in memory, and waiting for each costs more
// than blending it.
inline constexpr int64_t kPrefetch = 12;

template <class T>
GS_INLINE void prefetch(const TileJob<T>& job, const SplatGradient<T>* records, int64_t item) {
  if (item >= job.count) return;
  __builtin_prefetch(job.splats + job.entries[item].splat);
  const SplatGradient<T>* const record = records + job.entries[item].record;  // may span two cache lines
  __builtin_prefetch(&record->power, 1);
  __builtin_prefetch(&record->z, 1);
}

// Position of a block in an image plane, and the number of its columns and rows inside of the image.
struct BlockPlace {
  int64_t offset;     // of the first pixel
  int64_t row;        // stride between rows
  int columns, rows;  // inside of the image

  BlockPlace(int x0, int y0, int width, int height)
      : offset(int64_t(y0) * width + x0), row(width), columns(width - x0), rows(height - y0) {}
  bool whole() const { return columns >= kBlock && rows >= kBlock; }
  bool outside() const { return columns <= 0 || rows <= 0; }
};

// Loads a block; pixels outside of the image are 0.
template <class T>
GS_INLINE void load_block(const T* plane, const BlockPlace& at, Vector<T>* out) {
  if (at.whole()) return load_rows(plane + at.offset, at.row, out);
  T pixels[kBlock * kBlock] = {};
  for (int j = 0; j < kBlock && j < at.rows; ++j)
    for (int i = 0; i < kBlock && i < at.columns; ++i) pixels[kBlock * j + i] = plane[at.offset + at.row * j + i];
  load_rows(pixels, kBlock, out);
}

template <class T>
GS_INLINE void store_block(const Vector<T>* in, const BlockPlace& at, T* plane) {
  if (at.whole()) return store_rows(in, plane + at.offset, at.row);
  T pixels[kBlock * kBlock];
  store_rows(in, pixels, kBlock);
  for (int j = 0; j < kBlock && j < at.rows; ++j)
    for (int i = 0; i < kBlock && i < at.columns; ++i) plane[at.offset + at.row * j + i] = pixels[kBlock * j + i];
}

// Sets T to 1 inside of the image and 0 outside.
template <class T>
GS_INLINE void begin_block(const BlockPlace& at, Vector<T>* transmittance) {
  T ones[kBlock * kBlock];
  for (int i = 0; i < kBlock * kBlock; ++i) ones[i] = i % kBlock < at.columns && i / kBlock < at.rows ? T(1) : T(0);
  for (int k = 0; k < kVectors<T>; ++k) transmittance[k] = load<T>(ones + k * Simd<T>::lanes);
}

// Software pipeline that evaluates a sequence of splats at a vector of pixels, with each splat one step behind the previous one. The
// instructions for a splat wait for one another several times as long as they take, and a processor looks ahead by only two or three
// splats. Here the operands of each step have been ready since the previous splat.
template <class T>
class SplatPipeline {
 public:
  GS_INLINE SplatPipeline(Vector<T> x, Vector<T> y, const Splat<T>& first, const Splat<T>& second, const Splat<T>& third) : x_(x), y_(y) {
    offset_ = offset_of(first, x, y);
    step(first, second);
    step(second, third);
  }

  // Returns `raw` as in evaluate() for the first, the second … splat; `near` and `far` are the splats two and three positions after it.
  GS_INLINE Vector<T> next(const Splat<T>& near, const Splat<T>& far) {
    const Vector<T> raw = end_exp2(reaches_, power_);
    step(near, far);
    return raw;
  }

 private:
  GS_INLINE void step(const Splat<T>& near, const Splat<T>& far) {
    reaches_ = reaches<T>(exponent_);
    power_ = begin_exp2(exponent_);
    exponent_ = exponent_of(near, offset_);
    offset_ = offset_of(far, x_, y_);
  }

  Vector<T> x_, y_;
  Offset<T> offset_;
  Vector<T> exponent_{};
  Mask<T> reaches_;
  Exp2<T> power_;
};

// Blends a tile. The list is processed in parts whose splats fit into the first-level cache. Each vector of pixels goes through the splats
// that touch its block with all sums in registers.
template <class T>
void blend_tile(const TileJob<T>& job, const RenderOutput<T>& out) {
  using V = Vector<T>;
  constexpr int part = 128;
  uint32_t splats[part], blocks_of[part], list[part + kListPadding];
  Pixels<T> pixels[kBlocks][kVectors<T>];
  uint32_t alive = 0;
  for (int block = 0; block < kBlocks; ++block) {
    const BlockPlace at(job.x0 + block % 4 * kBlock, job.y0 + block / 4 * kBlock, job.width, job.height);
    V transmittance[kVectors<T>];
    begin_block<T>(at, transmittance);
    for (int k = 0; k < kVectors<T>; ++k) pixels[block][k].transmittance = transmittance[k];
    alive |= uint32_t(!at.outside()) << block;
  }

  for (int64_t begin = 0; begin < job.count && alive != 0; begin += part) {
    const int count = int(job.count - begin < part ? job.count - begin : part);
    for (int i = 0; i < count; ++i) {
      const TileEntry& entry = job.entries[begin + i];
      __builtin_prefetch(job.splats + entry.splat);
      splats[i] = entry.splat;
      blocks_of[i] = entry.blocks;
    }
    for (uint32_t blocks = alive; blocks != 0; blocks &= blocks - 1) {
      const int block = __builtin_ctz(blocks);
      const int length = compress(splats, blocks_of, count, block, list);
      if (length == 0) continue;
      for (int i = 0; i < 3; ++i) list[length + i] = splats[0];  // evaluated in advance, but not blended
      const auto splat = [&](int i) -> const Splat<T>& { return job.splats[list[i]]; };
      bool goes_on = false;
      for (int k = 0; k < kVectors<T>; ++k) {
        Pixels<T> px = pixels[block][k];
        const V x = T(job.x0 + block % 4 * kBlock) + load<T>(kCenters<T>.x + k * Simd<T>::lanes);
        const V y = T(job.y0 + block / 4 * kBlock) + load<T>(kCenters<T>.y + k * Simd<T>::lanes);
        SplatPipeline<T> pipeline(x, y, splat(0), splat(1), splat(2));
        for (int i = 0; i < length; ++i)
          add(splat(i), blend<T>(px.transmittance, pipeline.next(splat(i + 2), splat(i + 3))), px);
        goes_on |= any(less(V{}, px.transmittance));
        pixels[block][k] = px;
      }
      if (!goes_on) alive &= ~(1u << block);
    }
  }

  const int64_t plane = int64_t(job.width) * job.height;
  for (int block = 0; block < kBlocks; ++block) {
    const BlockPlace at(job.x0 + block % 4 * kBlock, job.y0 + block / 4 * kBlock, job.width, job.height);
    if (at.outside()) continue;
    V red[kVectors<T>], green[kVectors<T>], blue[kVectors<T>], alpha[kVectors<T>], depth[kVectors<T>];
    for (int k = 0; k < kVectors<T>; ++k) {
      const Pixels<T>& px = pixels[block][k];
      red[k] = value_of(px.red);
      green[k] = value_of(px.green);
      blue[k] = value_of(px.blue);
      alpha[k] = px.alpha;
      depth[k] = expected_depth(px);
    }
    store_block(red, at, out.rgb);
    store_block(green, at, out.rgb + plane);
    store_block(blue, at, out.rgb + 2 * plane);
    store_block(alpha, at, out.alpha);
    store_block(depth, at, out.depth);
  }
}

template <class T>
GS_INLINE void load_gradients(const BlockPlace& at, int64_t plane, const RenderOutput<const T>& pictures,
                              const RenderOutput<const T>& gradients, PixelGradients<T>* out) {
  using V = Vector<T>;
  V transmittance[kVectors<T>], color[3][kVectors<T>], g_color[3][kVectors<T>];
  V alpha[kVectors<T>], g_alpha[kVectors<T>], depth[kVectors<T>], g_depth[kVectors<T>];
  begin_block<T>(at, transmittance);
  for (int channel = 0; channel < 3; ++channel) {
    load_block(pictures.rgb + channel * plane, at, color[channel]);
    load_block(gradients.rgb + channel * plane, at, g_color[channel]);
  }
  load_block(pictures.alpha, at, alpha);
  load_block(gradients.alpha, at, g_alpha);
  load_block(pictures.depth, at, depth);
  load_block(gradients.depth, at, g_depth);
  for (int k = 0; k < kVectors<T>; ++k) {
    const V c[3] = {color[0][k], color[1][k], color[2][k]}, g[3] = {g_color[0][k], g_color[1][k], g_color[2][k]};
    out[k] = pixel_gradients<T>(transmittance[k], c, alpha[k], depth[k], g, g_alpha[k], g_depth[k]);
  }
}

template <bool capped, class T>
GS_INLINE void accumulate_gradients(const Splat<T>& s, uint32_t blocks, const Evaluated<T> (&evaluated)[kBlocks][kVectors<T>],
                                    PixelGradients<T> (&pixels)[kBlocks][kVectors<T>], Vector<T> (&sums)[kSplatGradientNumbers]) {
  for (; blocks != 0; blocks &= blocks - 1) {
    const int block = __builtin_ctz(blocks);
    for (int k = 0; k < kVectors<T>; ++k) accumulate_gradient<T, capped>(s, evaluated[block][k], pixels[block][k], sums);
  }
}

// Computes gradients of a tile's splats and writes one record per entry. `pictures` are outputs of the forward pass, and `gradients` the
// loss's gradients with respect to them. Here the outer loop is over splats, so that a splat's ten sums over the tile stay in registers.
template <class T>
void blend_tile_backward(const TileJob<T>& job, const RenderOutput<const T>& pictures,
                         const RenderOutput<const T>& gradients, SplatGradient<T>* records) {
  using V = Vector<T>;
  PixelGradients<T> pixels[kBlocks][kVectors<T>];
  V x[4][kVectors<T>], y[4][kVectors<T>];  // pixel centers of the blocks of each column and row
  for (int i = 0; i < 4; ++i)
    for (int k = 0; k < kVectors<T>; ++k) {
      x[i][k] = T(job.x0 + i * kBlock) + load<T>(kCenters<T>.x + k * Simd<T>::lanes);
      y[i][k] = T(job.y0 + i * kBlock) + load<T>(kCenters<T>.y + k * Simd<T>::lanes);
    }
  for (int block = 0; block < kBlocks; ++block) {
    const BlockPlace at(job.x0 + block % 4 * kBlock, job.y0 + block / 4 * kBlock, job.width, job.height);
    load_gradients(at, int64_t(job.width) * job.height, pictures, gradients, pixels[block]);
  }

  // The blocks with active pixels are updated only once in a while: a check after every splat would delay the next one.
  constexpr int64_t while_items = 32;
  uint32_t alive = 0;
  Evaluated<T> evaluated[kBlocks][kVectors<T>];
  for (int64_t item = 0; item < job.count; ++item) {
    if (item % while_items == 0) {
      alive = 0;
      for (int block = 0; block < kBlocks; ++block)
        for (int k = 0; k < kVectors<T>; ++k)
          alive |= uint32_t(any(less(V{}, pixels[block][k].transmittance))) << block;
    }
    const TileEntry& entry = job.entries[item];
    prefetch(job, records, item + kPrefetch);
    const Splat<T>& s = job.splats[entry.splat];
    V sums[kSplatGradientNumbers] = {};
    const uint32_t reached = entry.blocks & alive;
    for (uint32_t blocks = reached; blocks != 0; blocks &= blocks - 1) {
      const int block = __builtin_ctz(blocks);
      for (int k = 0; k < kVectors<T>; ++k) evaluate(s, x[block % 4][k], y[block / 4][k], evaluated[block][k]);
    }
    if (may_be_capped(s))
      accumulate_gradients<true>(s, reached, evaluated, pixels, sums);
    else
      accumulate_gradients<false>(s, reached, evaluated, pixels, sums);
    sum_each(sums, &records[entry.record].power);
  }
}

// Adds the pairs that blending a tile processes to `counts`, for benchmarks.
template <class T>
void count_pairs(const TileJob<T>& job, PairCounts& counts) {
  Vector<T> transmittance[kBlocks][kVectors<T>];
  for (int block = 0; block < kBlocks; ++block)
    begin_block<T>({job.x0 + block % 4 * kBlock, job.y0 + block / 4 * kBlock, job.width, job.height}, transmittance[block]);
  counts.tile_entries += job.count;
  for (int64_t item = 0; item < job.count; ++item)
    for (uint32_t blocks = job.entries[item].blocks; blocks != 0; blocks &= blocks - 1) {
      const int block = __builtin_ctz(blocks);
      for (int k = 0; k < kVectors<T>; ++k) {
        Vector<T>& t = transmittance[block][k];
        if (!any(less(Vector<T>{}, t))) continue;
        const Vector<T> x = T(job.x0 + block % 4 * kBlock) + load<T>(kCenters<T>.x + k * Simd<T>::lanes);
        const Vector<T> y = T(job.y0 + block / 4 * kBlock) + load<T>(kCenters<T>.y + k * Simd<T>::lanes);
        Evaluated<T> e;
        evaluate(job.splats[job.entries[item].splat], x, y, e);
        const Contribution<T> c = blend<T>(t, e.raw);
        t = next_transmittance(c);
        counts.evaluated += Simd<T>::lanes;
        counts.contributing += __builtin_popcount(uint32_t(lane_bits(less(Vector<T>{}, c.weight))));
      }
    }
}

// Runs `rounds` times 16 independent vectors of multiply-adds. Returns the number of floating-point operations, two for each; `out` keeps
// the compiler from removing the computation.
inline int64_t multiply_adds(int64_t rounds, float* out) {
  constexpr int chains = 16;
  Vector<float> sums[chains];
  for (int k = 0; k < chains; ++k) sums[k] = broadcast<float>(*out + float(k));
  const Vector<float> factor = broadcast<float>(0.999f), term = broadcast<float>(*out);
  for (int64_t round = 0; round < rounds; ++round)
    for (Vector<float>& sum : sums) sum = fma(sum, factor, term);
  for (int k = 1; k < chains; ++k) sums[0] += sums[k];
  *out = sums[0][0];
  return rounds * chains * Simd<float>::lanes * 2;
}

}  // namespace globalsplat::raster::GS_ISA
