// One Gaussian seen by one camera, forward and backward.
//
//     t = W μ + p                          camera space; z ≤ 0.01 is dropped
//     (u, v) = (f_x t_x/z + c_x, f_y t_y/z + c_y)
//     J = [[f_x/z, 0, −f_x a/z], [0, f_y/z, −f_y b/z]],   a = clamp(t_x/z), b = clamp(t_y/z)
//     Σ2D = (J W R S)(J W R S)ᵀ + eps2d·I,  C = Σ2D⁻¹;    det ≤ 0 is dropped
//     colour = max(0, ½ + Σ_b Y_b(d) sh_b),  d = (μ − o)/‖μ − o‖,  o = −Wᵀ p.
//
// R is the rotation of the normalized quaternion, S = diag(scales). Only J sees the clamp: 15 % of the image's width
// (height) beyond its borders. Writing Σ2D as a product of one factor keeps it positive semi-definite in float.
#pragma once

#include <cmath>

#include "sh.h"
#include "types.h"

namespace globalsplat::raster {

// A camera with what all of its Gaussians share.
template <class T>
struct Lens {
  Camera<T> camera;
  int width, height;
  T eps2d;
  T centre[3];                     // o, world
  T x_low, x_high, y_low, y_high;  // the clamp of t_x/z and t_y/z

  Lens(const Camera<T>& c, int width, int height, T eps2d) : camera(c), width(width), height(height), eps2d(eps2d) {
    for (int k = 0; k < 3; ++k)
      centre[k] = -(c.rotation[k] * c.translation[0] + c.rotation[3 + k] * c.translation[1] +
                    c.rotation[6 + k] * c.translation[2]);
    const T margin_x = T(kJacobianMargin) * width / c.fx, margin_y = T(kJacobianMargin) * height / c.fy;
    x_low = -c.cx / c.fx - margin_x;
    x_high = (width - c.cx) / c.fx + margin_x;
    y_low = -c.cy / c.fy - margin_y;
    y_high = (height - c.cy) / c.fy + margin_y;
  }
};

// Everything between a Gaussian and its Splat that the backward pass needs again.
template <class T>
struct Projection {
  T t[3];             // camera space mean
  T a, b;             // clamped t_x/z, t_y/z
  bool a_free, b_free;
  T inverse_norm;     // 1/‖q‖
  T unit[4];          // q/‖q‖
  T rotation[9];      // R
  T wr[9];            // W R S
  T half[6];          // J W R S, 2×3
  T cov_xx, cov_xy, cov_yy, determinant;
  T direction[3], inverse_distance;
  T basis[kMaxBases];
  T colour[3];        // before the clamp at 0
};

template <class T>
inline void rotation_from_unit_quaternion(const T q[4], T r[9]) {
  const T w = q[0], x = q[1], y = q[2], z = q[3];
  r[0] = 1 - 2 * (y * y + z * z);
  r[1] = 2 * (x * y - w * z);
  r[2] = 2 * (x * z + w * y);
  r[3] = 2 * (x * y + w * z);
  r[4] = 1 - 2 * (x * x + z * z);
  r[5] = 2 * (y * z - w * x);
  r[6] = 2 * (x * z - w * y);
  r[7] = 2 * (y * z + w * x);
  r[8] = 1 - 2 * (x * x + y * y);
}

// False when the camera doesn't see Gaussian i at all. NaN anywhere in the geometry counts as not seen.
template <class T>
inline bool project(const Gaussians<T>& g, int64_t i, const Lens<T>& lens, Projection<T>& p, Splat<T>& s) {
  const Camera<T>& c = lens.camera;
  const T* mean = g.means + 3 * i;
  for (int r = 0; r < 3; ++r)
    p.t[r] = c.rotation[3 * r] * mean[0] + c.rotation[3 * r + 1] * mean[1] + c.rotation[3 * r + 2] * mean[2] +
             c.translation[r];
  const T z = p.t[2];
  if (!(z > T(kNearPlane))) return false;
  const T opacity = g.opacities[i];
  if (!(opacity >= T(kMinAlpha))) return false;

  const T x = p.t[0] / z, y = p.t[1] / z;
  p.a = x < lens.x_low ? lens.x_low : x > lens.x_high ? lens.x_high : x;
  p.b = y < lens.y_low ? lens.y_low : y > lens.y_high ? lens.y_high : y;
  p.a_free = p.a == x;
  p.b_free = p.b == y;

  const T* q = g.quaternions + 4 * i;
  p.inverse_norm = 1 / std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int k = 0; k < 4; ++k) p.unit[k] = q[k] * p.inverse_norm;
  rotation_from_unit_quaternion(p.unit, p.rotation);
  const T* scale = g.scales + 3 * i;
  for (int r = 0; r < 3; ++r)
    for (int k = 0; k < 3; ++k)
      p.wr[3 * r + k] = (c.rotation[3 * r] * p.rotation[k] + c.rotation[3 * r + 1] * p.rotation[3 + k] +
                         c.rotation[3 * r + 2] * p.rotation[6 + k]) *
                        scale[k];
  const T fx = c.fx / z, fy = c.fy / z;
  for (int k = 0; k < 3; ++k) {
    p.half[k] = fx * (p.wr[k] - p.a * p.wr[6 + k]);
    p.half[3 + k] = fy * (p.wr[3 + k] - p.b * p.wr[6 + k]);
  }
  const T* h = p.half;
  p.cov_xx = h[0] * h[0] + h[1] * h[1] + h[2] * h[2] + lens.eps2d;
  p.cov_xy = h[0] * h[3] + h[1] * h[4] + h[2] * h[5];
  p.cov_yy = h[3] * h[3] + h[4] * h[4] + h[5] * h[5] + lens.eps2d;
  // det(H Hᵀ + εI) = |h₁ × h₂|² + ε (tr + ε): no cancellation for needles, unlike xx·yy − xy².
  const T cross_x = h[1] * h[5] - h[2] * h[4], cross_y = h[2] * h[3] - h[0] * h[5], cross_z = h[0] * h[4] - h[1] * h[3];
  p.determinant = cross_x * cross_x + cross_y * cross_y + cross_z * cross_z +
                  lens.eps2d * (p.cov_xx + p.cov_yy - lens.eps2d);
  if (!(p.determinant > 0) || !std::isfinite(p.determinant)) return false;

  s.u = c.fx * x + c.cx;
  s.v = c.fy * y + c.cy;
  // ½Σ2D⁻¹ = [[a², ab], [ab, b² + c²]]; the Schur complement of an inverse is the inverse of an entry: 2c² = 1/Σ_yy.
  s.a = std::sqrt(T(0.5) * p.cov_yy / p.determinant);
  s.b = -s.a * p.cov_xy / p.cov_yy;
  s.c = std::sqrt(T(0.5) / p.cov_yy);
  s.opacity = opacity;
  s.z = z;
  // α ≥ 1/255 ⟺ σ ≤ ln(255·opacity). The room on top covers the rounding of σ, whose terms may be larger than σ itself.
  const T exact = std::log(opacity * T(255));
  s.max_power = exact + T(1e-3) * (1 + exact);
  s.half_height = std::sqrt(s.max_power) / s.c * (1 + T(1e-5)) + T(1e-3);

  T distance2 = 0;
  for (int k = 0; k < 3; ++k) {
    p.direction[k] = mean[k] - lens.centre[k];
    distance2 += p.direction[k] * p.direction[k];
  }
  p.inverse_distance = 1 / std::sqrt(distance2);
  for (int k = 0; k < 3; ++k) p.direction[k] *= p.inverse_distance;
  sh_basis(g.bases, p.direction, p.basis);
  const T* coefficients = g.sh + int64_t(3) * g.bases * i;
  for (int channel = 0; channel < 3; ++channel) {
    T value = T(0.5);
    for (int k = 0; k < g.bases; ++k) value += p.basis[k] * coefficients[3 * k + channel];
    p.colour[channel] = value;
  }
  s.red = p.colour[0] > 0 ? p.colour[0] : T(0);
  s.green = p.colour[1] > 0 ? p.colour[1] : T(0);
  s.blue = p.colour[2] > 0 ? p.colour[2] : T(0);
  return std::isfinite(s.u) && std::isfinite(s.v) && s.a > 0 && s.c > 0;
}

// Gradients of one Gaussian, summed over cameras.
template <class T>
struct GaussianGradient {
  T mean[3] = {}, scale[3] = {}, quaternion[4] = {}, opacity = 0, sh[kMaxBases * 3] = {};
};

// Adds what one camera's pixels, summed in `d`, ask of Gaussian i. `p` and `s` are what project() gave.
template <class T>
inline void project_backward(const Gaussians<T>& g, int64_t i, const Lens<T>& lens, const Projection<T>& p,
                             const Splat<T>& s, const SplatGradient<T>& d, GaussianGradient<T>& out) {
  const Camera<T>& c = lens.camera;
  const T z = p.t[2];

  // α = opacity·e^{−σ} and ν = −α ∂L/∂α, so ∂L/∂opacity = Σ e^{−σ} ∂L/∂α = −Σν / opacity.
  out.opacity -= d.power / s.opacity;

  // Colour, and the mean through the direction: d = r/‖r‖, ∂d/∂r = (I − d dᵀ)/‖r‖.
  const T d_colour[3] = {p.colour[0] > 0 ? d.red : T(0), p.colour[1] > 0 ? d.green : T(0),
                         p.colour[2] > 0 ? d.blue : T(0)};
  const T* coefficients = g.sh + int64_t(3) * g.bases * i;
  T d_basis[kMaxBases], d_direction[3];
  for (int k = 0; k < g.bases; ++k) {
    d_basis[k] = 0;
    for (int channel = 0; channel < 3; ++channel) {
      out.sh[3 * k + channel] += p.basis[k] * d_colour[channel];
      d_basis[k] += coefficients[3 * k + channel] * d_colour[channel];
    }
  }
  sh_basis_backward(g.bases, p.direction, d_basis, d_direction);
  const T along = d_direction[0] * p.direction[0] + d_direction[1] * p.direction[1] + d_direction[2] * p.direction[2];
  for (int k = 0; k < 3; ++k) out.mean[k] += (d_direction[k] - along * p.direction[k]) * p.inverse_distance;

  // With U = [[a, b], [0, c]], σ = |UΔ|² and Σ2D⁻¹ = 2UᵀU. From M = Σ ν UΔ and W = Σ ν (UΔ)(UΔ)ᵀ,
  // ∂L/∂(u, v) = 2UᵀM and ∂L/∂Σ2D = −2UᵀWU.
  const T d_u = 2 * s.a * d.power_p;
  const T d_v = 2 * (s.b * d.power_p + s.c * d.power_r);
  const T m_xx = -2 * s.a * s.a * d.power_pp;
  const T m_xy = -2 * s.a * (s.b * d.power_pp + s.c * d.power_pr);
  const T m_yy = -2 * (s.b * s.b * d.power_pp + 2 * s.b * s.c * d.power_pr + s.c * s.c * d.power_rr);

  // Σ2D = H Hᵀ + εI: ∂L/∂H = 2 (∂L/∂Σ2D) H;  H = J V with V = W R S.
  T d_half[6], d_wr[9];
  for (int k = 0; k < 3; ++k) {
    d_half[k] = 2 * (m_xx * p.half[k] + m_xy * p.half[3 + k]);
    d_half[3 + k] = 2 * (m_xy * p.half[k] + m_yy * p.half[3 + k]);
  }
  const T fx = c.fx / z, fy = c.fy / z;
  T d_fx = 0, d_fy = 0, d_a = 0, d_b = 0;  // of f_x/z, f_y/z, a, b
  for (int k = 0; k < 3; ++k) {
    d_wr[k] = fx * d_half[k];
    d_wr[3 + k] = fy * d_half[3 + k];
    d_wr[6 + k] = -fx * p.a * d_half[k] - fy * p.b * d_half[3 + k];
    d_fx += d_half[k] * (p.wr[k] - p.a * p.wr[6 + k]);
    d_fy += d_half[3 + k] * (p.wr[3 + k] - p.b * p.wr[6 + k]);
    d_a -= fx * d_half[k] * p.wr[6 + k];
    d_b -= fy * d_half[3 + k] * p.wr[6 + k];
  }

  // t_x/z reaches u always and a where it isn't clamped.
  const T d_x = c.fx * d_u + (p.a_free ? d_a : T(0));
  const T d_y = c.fy * d_v + (p.b_free ? d_b : T(0));
  const T d_t[3] = {d_x / z, d_y / z,
                    d.z - (d_x * p.t[0] + d_y * p.t[1]) / (z * z) - (d_fx * c.fx + d_fy * c.fy) / (z * z)};
  for (int k = 0; k < 3; ++k)
    out.mean[k] += c.rotation[k] * d_t[0] + c.rotation[3 + k] * d_t[1] + c.rotation[6 + k] * d_t[2];

  // V = W R S.
  const T* scale = g.scales + 3 * i;
  T d_rotation[9];
  for (int k = 0; k < 3; ++k) {
    for (int r = 0; r < 3; ++r) {
      const T through = c.rotation[r] * d_wr[k] + c.rotation[3 + r] * d_wr[3 + k] + c.rotation[6 + r] * d_wr[6 + k];
      out.scale[k] += through * p.rotation[3 * r + k];
      d_rotation[3 * r + k] = through * scale[k];
    }
  }

  // R of the unit quaternion, then the normalization: ∂/∂q = (I − q̂ q̂ᵀ)/‖q‖.
  const T w = p.unit[0], x = p.unit[1], y = p.unit[2], zq = p.unit[3];
  const T* r = d_rotation;
  const T d_unit[4] = {
      2 * (-zq * r[1] + y * r[2] + zq * r[3] - x * r[5] - y * r[6] + x * r[7]),
      2 * (y * r[1] + zq * r[2] + y * r[3] - 2 * x * r[4] - w * r[5] + zq * r[6] + w * r[7] - 2 * x * r[8]),
      2 * (-2 * y * r[0] + x * r[1] + w * r[2] + x * r[3] + zq * r[5] - w * r[6] + zq * r[7] - 2 * y * r[8]),
      2 * (-2 * zq * r[0] - w * r[1] + x * r[2] + w * r[3] - 2 * zq * r[4] + y * r[5] + x * r[6] + y * r[7])};
  const T inward = d_unit[0] * w + d_unit[1] * x + d_unit[2] * y + d_unit[3] * zq;
  for (int k = 0; k < 4; ++k) out.quaternion[k] += (d_unit[k] - inward * p.unit[k]) * p.inverse_norm;
}

}  // namespace globalsplat::raster
