// Alpha blending at pixels, forward and backward (spec 6.4 and 6.5).
//
// For a pixel and the splats in front-to-back order i = 1, 2, …
//     e_i = log₂ opacity_i − p² − r²,  p = aΔx + bΔy,  r = cΔy,  Δ = mean2d_i − pixel center
//     α_i = min(0.999, 2^e_i),            skipped if e_i < −log₂ 255
//     w_i = T_i α_i,  T_{i+1} = T_i − w_i,  T_1 = 1,  the pixel ends before T_{i+1} ≤ 1e-4
//     C = Σ w_i c_i,   A = Σ w_i = 1 − T,   D = Σ w_i z_i / A.
//
// Backward: with the images' gradients g_C, g_A, g_D, ∂D/∂w_i = (z_i − D) / A, so that
//     q_i = ∂L/∂w_i = g_C·c_i + (g_D / A) z_i + (g_A − g_D D / A)
//     α_i ∂L/∂α_i = w_i q_i − (Σ_{j>i} w_j q_j) α_i / (1 − α_i) = w_i (q_i − (Σ_{j>i} w_j q_j) / T_{i+1}).
// The sum over the splats behind is the pixel's total, which follows from the images alone, Q = Σ w_j q_j = g_C·C + g_A A, minus the terms
// of the splats already processed. The tile is therefore replayed front to back, and nothing has to be stored per pixel.
//
// Pixels that have ended, or lie outside of the image, have T = 0: their weights are 0 and T_{i+1} ≤ 1e-4 holds for all further splats, so
// no other mask is needed.
#pragma once

#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// Offset of a vector of pixels from a splat's mean, in units of the splat's widths.
template <class T>
struct Offset {
  Vector<T> p, r;
};

// A splat evaluated at a vector of pixels.
template <class T>
struct Evaluated : Offset<T> {
  Vector<T> raw;      // α without its cap; 0 beyond the splat's reach
};

// Contribution of a splat to a vector of pixels.
template <class T>
struct Contribution {
  Vector<T> weight;   // 0 also if the pixel ends here, or has ended before
  Vector<T> behind;   // T behind the splat
  Mask<T> goes_on;    // T behind the splat > 1e-4
};

template <class T>
GS_INLINE Offset<T> offset_of(const Splat<T>& s, Vector<T> x, Vector<T> y) {
  const Vector<T> dx = s.u - x, dy = s.v - y;
  return {fma(s.a, dx, s.b * dy), s.c * dy};
}

template <class T>
GS_INLINE Vector<T> exponent_of(const Splat<T>& s, const Offset<T>& at) {
  return fnma(at.p, at.p, fnma(at.r, at.r, s.log2_opacity));
}

template <class T>
GS_INLINE Mask<T> reaches(Vector<T> exponent) {
  return less_equal(broadcast<T>(T(-kLog2Of255)), exponent);
}

// Returns true if α may reach its cap, which is the case for few splats.
template <class T>
GS_INLINE bool may_be_capped(const Splat<T>& s) {
  return s.log2_opacity > T(-0.0015);  // log₂ 0.99896, with a margin for rounding
}

// Evaluates a splat at a vector of pixels. `table` is an optional additional argument for the instruction set's exp2_where().
template <class T, class... Table>
GS_INLINE void evaluate(const Splat<T>& s, Vector<T> x, Vector<T> y, Evaluated<T>& e, const Table&... table) {
  const Offset<T> at = offset_of(s, x, y);
  const Vector<T> exponent = exponent_of(s, at);
  e.p = at.p;
  e.r = at.r;
  e.raw = exp2_where(reaches<T>(exponent), exponent, table...);
}

// Computes a splat's contribution. `capped` tells if any α may exceed the cap.
template <class T, bool capped = true>
GS_INLINE Contribution<T> blend(Vector<T> transmittance, Vector<T> raw) {
  const Vector<T> weight = transmittance * (capped ? smaller(raw, broadcast<T>(T(kMaxAlpha))) : raw);
  const Vector<T> behind = transmittance - weight;
  const Mask<T> goes_on = less(broadcast<T>(T(kMinTransmittance)), behind);
  return {select(goes_on, weight, Vector<T>{}), behind, goes_on};
}

// Returns T after a contribution; 0 if the pixel has ended.
template <class T>
GS_INLINE Vector<T> next_transmittance(const Contribution<T>& c) {
  return select(c.goes_on, c.behind, Vector<T>{});
}

// Accumulated sums of a vector of pixels.
template <class T>
struct Pixels {
  Vector<T> transmittance, alpha{};
  FusedSum<T> red{}, green{}, blue{}, z{};
};

template <class T>
GS_INLINE void add(const Splat<T>& s, const Contribution<T>& c, Pixels<T>& px) {
  px.alpha += c.weight;
  px.red = add_fused(c.weight, s.red, px.red);
  px.green = add_fused(c.weight, s.green, px.green);
  px.blue = add_fused(c.weight, s.blue, px.blue);
  px.z = add_fused(c.weight, s.z, px.z);
  px.transmittance = next_transmittance(c);
}

template <class T>
GS_INLINE Vector<T> expected_depth(const Pixels<T>& px) {
  return select(less(broadcast<T>(T(kMinDepthAlpha)), px.alpha), value_of(px.z) / px.alpha, Vector<T>{});
}

// State of the backward pass for a vector of pixels: T, the rest of Q after the splats already processed, and the coefficients of q_i =
// g_red·r + g_green·g + g_blue·b + per_z·z + constant.
template <class T>
struct PixelGradients {
  Vector<T> transmittance, remaining, g_red, g_green, g_blue, per_z, constant;
};

// Returns the state before the first splat, from the outputs of the forward pass and the gradients with respect to them.
template <class T>
GS_INLINE PixelGradients<T> pixel_gradients(Vector<T> transmittance, const Vector<T> color[3], Vector<T> alpha, Vector<T> depth,
                                            const Vector<T> g_color[3], Vector<T> g_alpha, Vector<T> g_depth) {
  const Vector<T> per_z = select(less(broadcast<T>(T(kMinDepthAlpha)), alpha), g_depth / alpha, Vector<T>{});
  Vector<T> total = g_alpha * alpha;
  for (int channel = 0; channel < 3; ++channel) total = add_product(g_color[channel], color[channel], total);
  return {transmittance, total, g_color[0], g_color[1], g_color[2], per_z, g_alpha - per_z * depth};
}

// Processes a splat: updates the state, and adds the splat's gradient to `sums`, in SplatGradient's order.
template <class T, bool capped = true>
GS_INLINE void accumulate_gradient(const Splat<T>& s, const Evaluated<T>& e, PixelGradients<T>& px, Vector<T> sums[kSplatGradientNumbers]) {
  using V = Vector<T>;
  const Contribution<T> c = blend<T, capped>(px.transmittance, e.raw);
  V q = add_product(px.g_red, broadcast<T>(s.red), px.constant);
  q = add_product(px.g_green, broadcast<T>(s.green), q);
  q = add_product(px.g_blue, broadcast<T>(s.blue), q);
  q = add_product(px.per_z, broadcast<T>(s.z), q);
  px.remaining = subtract_product(c.weight, q, px.remaining);

  // ν = −α ∂L/∂α; no gradient passes the cap.
  const Mask<T> follows = capped ? both(c.goes_on, less(e.raw, broadcast<T>(T(kMaxAlpha)))) : c.goes_on;
  const V nu = select(follows, c.weight * (px.remaining * reciprocal(c.behind) - q), V{});
  const V nu_p = nu * e.p, nu_r = nu * e.r;
  sums[0] += nu;
  sums[1] += nu_p;
  sums[2] += nu_r;
  sums[3] = add_product(nu_p, e.p, sums[3]);
  sums[4] = add_product(nu_p, e.r, sums[4]);
  sums[5] = add_product(nu_r, e.r, sums[5]);
  sums[6] = add_product(c.weight, px.g_red, sums[6]);
  sums[7] = add_product(c.weight, px.g_green, sums[7]);
  sums[8] = add_product(c.weight, px.g_blue, sums[8]);
  sums[9] = add_product(c.weight, px.per_z, sums[9]);

  px.transmittance = next_transmittance(c);
}

}  // namespace globalsplat::raster::GS_ISA
