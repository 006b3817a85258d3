// Alpha blending of one 16×16 tile, forward and backward.
//
// For a pixel and the splats in front-to-back order i = 1, 2, …
//     σ_i = ½ Δᵀ Σ2D⁻¹ Δ = p² + r²,  p = aΔx + bΔy,  r = cΔy,  Δ = mean2d_i − pixel centre
//     α_i = min(0.999, opacity_i · e^{−σ_i}),            skipped when α_i < 1/255
//     w_i = T_i α_i,  T_{i+1} = T_i (1 − α_i),  T_1 = 1,  the pixel ends before T_{i+1} ≤ 1e-4
//     C = Σ w_i c_i,   A = Σ w_i = 1 − T,   D = Σ w_i z_i / A.
//
// Backward. With the pictures' gradients g_C, g_A, g_D, ∂D/∂w_i = (z_i − D) / A, so that
//     q_i = ∂L/∂w_i = g_C·c_i + (g_D / A) z_i + (g_A − g_D D / A)
//     ∂L/∂α_i = T_i q_i − (Σ_{j>i} w_j q_j) / (1 − α_i).
// The sum over what lies behind is the pixel's total, known from the pictures alone, Q = Σ w_j q_j = g_C·C + g_A A,
// less what has been passed: the tile is replayed front to back and nothing per pixel has to be stored.
//
// A vector holds consecutive pixels of a row. Pixels that ended, or lie outside the image, have T = 0: their weights
// vanish and T_{i+1} ≤ 1e-4 holds for ever, so no other mask is carried.
#pragma once

#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

template <class T>
struct TileShape {
  static constexpr int lanes = Simd<T>::lanes;
  static constexpr int per_row = kTile / lanes;         // vectors in a row
  static constexpr int vectors = kTile * per_row;       // vectors in the tile
};

// Which of a tile's rows a splat can reach.
struct Rows {
  int begin, end;
};

template <class T>
GS_INLINE Rows reached_rows(const Splat<T>& s, int y0) {
  // First row whose centre y0 + r + ½ is not above v − h, and one past the last that is not below v + h.
  const T first = s.v - s.half_height - T(y0) - T(0.5);
  const T last = s.v + s.half_height - T(y0) - T(0.5);
  Rows rows{0, kTile};
  if (first > T(0)) rows.begin = first < T(kTile) ? int(__builtin_ceil(double(first))) : kTile;
  if (last < T(kTile - 1)) rows.end = last >= T(0) ? int(last) + 1 : 0;
  return rows;
}

// What a splat does to a vector of pixels: α, before and after its cap, and T behind it.
template <class T>
struct Contribution {
  Vector<T> unclamped, alpha, behind;
  Mask<T> reaches;  // α ≥ 1/255
  Mask<T> blends;   // and the pixel goes on: T behind it > 1e-4
};

template <class T>
GS_INLINE void contribute(const Splat<T>& s, Vector<T> sigma, Vector<T> transmittance, Contribution<T>& c) {
  // Beyond 87 e^{−σ} leaves float's range, and no α comes near 1/255.
  const Vector<T> limit = broadcast<T>(T(87));
  c.unclamped = s.opacity * exp(-(sigma < limit ? sigma : limit));
  const Vector<T> cap = broadcast<T>(T(kMaxAlpha));
  c.alpha = c.unclamped < cap ? c.unclamped : cap;
  c.behind = transmittance * (T(1) - c.alpha);
  c.reaches = c.alpha >= broadcast<T>(T(kMinAlpha));
  c.blends = c.reaches & (c.behind > broadcast<T>(T(kMinTransmittance)));
}

// x of the pixel centres of the vector that starts at pixel column x0.
template <class T>
GS_INLINE Vector<T> centres(int x0) {
  Vector<T> x;
  for (int i = 0; i < Simd<T>::lanes; ++i) x[i] = T(x0 + i) + T(0.5);
  return x;
}

// 1 inside the image, 0 outside.
template <class T>
GS_INLINE Vector<T> inside(int x0, int y, int width, int height) {
  Vector<T> t;
  for (int i = 0; i < Simd<T>::lanes; ++i) t[i] = y < height && x0 + i < width ? T(1) : T(0);
  return t;
}

template <class T>
void blend_tile(const TileJob<T>& job, const Pictures<T>& out) {
  using V = Vector<T>;
  using Shape = TileShape<T>;
  V transmittance[Shape::vectors], ended[Shape::vectors];  // T of pixels that go on, and of those that ended
  V red[Shape::vectors], green[Shape::vectors], blue[Shape::vectors], depth[Shape::vectors];
  V x[Shape::per_row];
  int going_on = 0;
  for (int k = 0; k < Shape::per_row; ++k) x[k] = centres<T>(job.x0 + k * Shape::lanes);
  for (int i = 0; i < Shape::vectors; ++i) {
    const int column = job.x0 + i % Shape::per_row * Shape::lanes, row = job.y0 + i / Shape::per_row;
    transmittance[i] = inside<T>(column, row, job.width, job.height);
    going_on += any(transmittance[i] > V{});
    red[i] = green[i] = blue[i] = depth[i] = ended[i] = V{};
  }

  for (int64_t item = 0; item < job.count && going_on > 0; ++item) {
    const Splat<T>& s = job.splats[job.entries[item].splat];
    const Rows rows = reached_rows(s, job.y0);
    for (int row = rows.begin; row < rows.end; ++row) {
      const T dy = s.v - (T(job.y0 + row) + T(0.5)), r = s.c * dy;
      for (int k = 0; k < Shape::per_row; ++k) {
        const int i = row * Shape::per_row + k;
        const V p = fma(broadcast<T>(s.a), s.u - x[k], broadcast<T>(s.b * dy));
        const V sigma = fma(p, p, broadcast<T>(r * r));
        if (!any((sigma <= broadcast<T>(s.max_power)) & (transmittance[i] > V{}))) continue;
        Contribution<T> c;
        contribute(s, sigma, transmittance[i], c);

        const V weight = c.blends ? transmittance[i] * c.alpha : V{};
        red[i] = fma(weight, broadcast<T>(s.red), red[i]);
        green[i] = fma(weight, broadcast<T>(s.green), green[i]);
        blue[i] = fma(weight, broadcast<T>(s.blue), blue[i]);
        depth[i] = fma(weight, broadcast<T>(s.z), depth[i]);

        const Mask<T> ends = c.reaches & ~c.blends & (transmittance[i] > V{});
        const V next = c.blends ? c.behind : transmittance[i];
        if (any(ends)) {
          ended[i] = ends ? transmittance[i] : ended[i];
          transmittance[i] = ends ? V{} : next;
          going_on -= !any(transmittance[i] > V{});
        } else {
          transmittance[i] = next;
        }
      }
    }
  }

  const int64_t plane = int64_t(job.width) * job.height;
  for (int i = 0; i < Shape::vectors; ++i) {
    const int column = job.x0 + i % Shape::per_row * Shape::lanes, row = job.y0 + i / Shape::per_row;
    if (row >= job.height) break;
    const V alpha = T(1) - (transmittance[i] + ended[i]);
    const V divisor = alpha > broadcast<T>(T(kMinDepthAlpha)) ? alpha : broadcast<T>(T(1));
    const V expected = alpha > broadcast<T>(T(kMinDepthAlpha)) ? depth[i] / divisor : V{};
    for (int lane = 0; lane < Shape::lanes && column + lane < job.width; ++lane) {
      const int64_t pixel = int64_t(row) * job.width + column + lane;
      out.rgb[pixel] = red[i][lane];
      out.rgb[pixel + plane] = green[i][lane];
      out.rgb[pixel + 2 * plane] = blue[i][lane];
      out.alpha[pixel] = alpha[lane];
      out.depth[pixel] = expected[lane];
    }
  }
}

// `pictures` are the forward pass's own, `gradients` the loss's with respect to them; one record per entry is written.
template <class T>
void blend_tile_backward(const TileJob<T>& job, const Pictures<const T>& pictures,
                         const Pictures<const T>& gradients, SplatGradient<T>* records) {
  using V = Vector<T>;
  using Shape = TileShape<T>;
  // Per pixel: T, Q less what has been passed, and q_i = g_red·r + g_green·g + g_blue·b + per_z·z + constant.
  V transmittance[Shape::vectors], remaining[Shape::vectors];
  V g_red[Shape::vectors], g_green[Shape::vectors], g_blue[Shape::vectors];
  V per_z[Shape::vectors], constant[Shape::vectors], x[Shape::per_row];
  const int64_t plane = int64_t(job.width) * job.height;
  for (int k = 0; k < Shape::per_row; ++k) x[k] = centres<T>(job.x0 + k * Shape::lanes);
  for (int i = 0; i < Shape::vectors; ++i) {
    const int column = job.x0 + i % Shape::per_row * Shape::lanes, row = job.y0 + i / Shape::per_row;
    transmittance[i] = inside<T>(column, row, job.width, job.height);
    remaining[i] = g_red[i] = g_green[i] = g_blue[i] = per_z[i] = constant[i] = V{};
    if (row >= job.height) continue;
    for (int lane = 0; lane < Shape::lanes && column + lane < job.width; ++lane) {
      const int64_t pixel = int64_t(row) * job.width + column + lane;
      const T r = gradients.rgb[pixel], g = gradients.rgb[pixel + plane], b = gradients.rgb[pixel + 2 * plane];
      const T alpha = pictures.alpha[pixel], g_alpha = gradients.alpha[pixel];
      const T g_depth = alpha > T(kMinDepthAlpha) ? gradients.depth[pixel] / alpha : T(0);
      g_red[i][lane] = r;
      g_green[i][lane] = g;
      g_blue[i][lane] = b;
      per_z[i][lane] = g_depth;
      constant[i][lane] = g_alpha - g_depth * pictures.depth[pixel];
      remaining[i][lane] = r * pictures.rgb[pixel] + g * pictures.rgb[pixel + plane] +
                           b * pictures.rgb[pixel + 2 * plane] + g_alpha * alpha;
    }
  }

  for (int64_t item = 0; item < job.count; ++item) {
    const TileEntry& entry = job.entries[item];
    const Splat<T>& s = job.splats[entry.splat];
    const Rows rows = reached_rows(s, job.y0);
    V n{}, np{}, nr{}, npp{}, npr{}, nrr{}, red{}, green{}, blue{}, z{};
    for (int row = rows.begin; row < rows.end; ++row) {
      const T dy = s.v - (T(job.y0 + row) + T(0.5)), r = s.c * dy;
      for (int k = 0; k < Shape::per_row; ++k) {
        const int i = row * Shape::per_row + k;
        const V p = fma(broadcast<T>(s.a), s.u - x[k], broadcast<T>(s.b * dy));
        const V sigma = fma(p, p, broadcast<T>(r * r));
        if (!any((sigma <= broadcast<T>(s.max_power)) & (transmittance[i] > V{}))) continue;
        Contribution<T> c;
        contribute(s, sigma, transmittance[i], c);

        const V weight = c.blends ? transmittance[i] * c.alpha : V{};
        V q = fma(g_red[i], broadcast<T>(s.red), constant[i]);
        q = fma(g_green[i], broadcast<T>(s.green), q);
        q = fma(g_blue[i], broadcast<T>(s.blue), q);
        q = fma(per_z[i], broadcast<T>(s.z), q);
        remaining[i] -= weight * q;

        // ν = ∂L/∂σ = −α ∂L/∂α, nothing through the cap.
        const V d_alpha = transmittance[i] * q - remaining[i] / (T(1) - c.alpha);
        const V nu = (c.blends & (c.unclamped < broadcast<T>(T(kMaxAlpha)))) ? -c.alpha * d_alpha : V{};
        const V nu_p = nu * p;
        n += nu;
        np += nu_p;
        nr = fma(nu, broadcast<T>(r), nr);
        npp = fma(nu_p, p, npp);
        npr = fma(nu_p, broadcast<T>(r), npr);
        nrr = fma(nu, broadcast<T>(r * r), nrr);
        red = fma(weight, g_red[i], red);
        green = fma(weight, g_green[i], green);
        blue = fma(weight, g_blue[i], blue);
        z = fma(weight, per_z[i], z);

        const Mask<T> ends = c.reaches & ~c.blends;
        const V next = c.blends ? c.behind : transmittance[i];
        transmittance[i] = ends ? V{} : next;
      }
    }
    records[entry.record] = {sum<T>(n),   sum<T>(np),  sum<T>(nr),    sum<T>(npp),  sum<T>(npr),
                             sum<T>(nrr), sum<T>(red), sum<T>(green), sum<T>(blue), sum<T>(z)};
  }
}

}  // namespace globalsplat::raster::GS_ISA
