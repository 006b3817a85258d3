// Projection of Gaussians into cameras, forward and backward, a vector of Gaussians at a time (spec 6.2).
//
//     t = W μ + p                          camera space; z ≤ near_plane and z ≥ far_plane are dropped
//     (u, v) = (f_x t_x/z + c_x, f_y t_y/z + c_y)
//     J = [[f_x/z, 0, −f_x a/z], [0, f_y/z, −f_y b/z]],   a = clamp(t_x/z), b = clamp(t_y/z)
//     Σ2D = H Hᵀ + eps2d·I with H = J W R S;  det ≤ 0 is dropped
//     color = max(0, ½ + Σ_b Y_b(d) sh_b),  d = (μ − o)/‖μ − o‖,  o = −Wᵀ p;  with `direct_colors` color = sh_0.
//
// If `antialiased` is set, opacities are multiplied by ρ = √(det(H Hᵀ) / det Σ2D), so that eps2d widens a Gaussian without adding to its
// integral (Mip-Splatting, Yu et al. 2024, eq. 8).
//
// R is the rotation of the normalized quaternion, S = diag(scales). A quaternion whose largest component is 0, subnormal or not finite has
// no rotation: R is NaN, and the Gaussian is dropped. The clamp, 15 % of the image's width (height) beyond its borders, affects only J.
// Writing Σ2D as the product of a factor with its transpose keeps it positive semi-definite in floating point.
//
// All cameras of a scene are processed while a vector of its Gaussians is loaded: work that doesn't depend on the camera, above all reading
// 59 values of each Gaussian and transposing them into lanes, is done once.
#pragma once

#include "sh.h"
#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// Group of as many Gaussians as a vector has lanes.
template <class T>
struct Group {
  int count;             // number of lanes in use; the others repeat the last Gaussian
  Vector<T> mean[3], scale[3];
  Vector<T> power, inverse_norm, unit[4];  // a power of two near 1/‖q‖, 1/‖power q‖, q/‖q‖
  Vector<T> rotation[9], axes[9];        // R, R S
  Vector<T> opacity, log2_opacity;
  Vector<T> sh[kMaxBases * 3];
};

// Projection of a group into one camera, with the intermediate values that the backward pass needs.
template <class T>
struct Projection {
  Mask<T> visible;
  Vector<T> t[3], inverse_z;
  Vector<T> a, b;                   // clamped t_x/z, t_y/z
  Mask<T> is_a_unclamped, is_b_unclamped;
  Vector<T> wrs[9], jwrs[6];        // W R S and J W R S (2×3)
  Vector<T> normal[3], normal2;     // cross product of H's rows and its square, det(H Hᵀ)
  Vector<T> cov_xx, cov_xy, cov_yy, determinant;
  Vector<T> log2_opacity;           // of the opacity times ρ
  Vector<T> factor_a, factor_b, factor_c;  // Splat's a, b, c
};

// Colors of a group in one camera.
template <class T>
struct Shading {
  Vector<T> direction[3], inverse_distance, basis[kMaxBases];
  Vector<T> color[3];  // without the clamp at 0
};

// True if transpose4() can convert rows to lanes and back, for multiples of four elements and as many rows as lanes.
template <class T>
inline constexpr bool kByFours = sizeof(T) == 4 && Simd<T>::lanes % 4 == 0;

// Loads rows of `width` elements, `stride` apart, into lanes: out[k] holds element k of each of the group's rows.
template <class T>
GS_INLINE void load_columns(const T* rows, int stride, int width, int count, Vector<T>* out) {
  constexpr int lanes = Simd<T>::lanes;
  T columns[kMaxBases * 3][lanes];
  int done = 0;
  if constexpr (kByFours<T>) {
    done = count == lanes ? width / 4 * 4 : 0;
    for (int lane = 0; lane < lanes; lane += 4)
      for (int k = 0; k < done; k += 4) transpose4(rows + int64_t(stride) * lane + k, stride, &columns[k][lane], lanes);
  }
  for (int lane = 0; lane < lanes; ++lane) {
    const T* row = rows + int64_t(stride) * (lane < count ? lane : count - 1);
    for (int k = done; k < width; ++k) columns[k][lane] = row[k];
  }
  for (int k = 0; k < width; ++k) out[k] = load<T>(columns[k]);
}

// Stores the first `count` lanes to consecutive rows: the inverse of load_columns().
template <class T>
GS_INLINE void store_columns(const Vector<T>* in, int width, int count, T* rows) {
  constexpr int lanes = Simd<T>::lanes;
  T columns[kMaxBases * 3][lanes];
  for (int k = 0; k < width; ++k) store<T>(columns[k], in[k]);
  int done = 0;
  if constexpr (kByFours<T>) {
    done = count == lanes ? width / 4 * 4 : 0;
    for (int lane = 0; lane < lanes; lane += 4)
      for (int k = 0; k < done; k += 4) transpose4(&columns[k][lane], lanes, rows + int64_t(width) * lane + k, width);
  }
  for (int lane = 0; lane < count; ++lane)
    for (int k = done; k < width; ++k) rows[int64_t(width) * lane + k] = columns[k][lane];
}

// Loads everything except spherical harmonics.
template <class T>
GS_INLINE void load_shapes(const Gaussians<T>& g, int64_t begin, int64_t end, Group<T>& group) {
  using V = Vector<T>;
  constexpr int lanes = Simd<T>::lanes;
  group.count = int(end - begin < lanes ? end - begin : lanes);
  load_columns(g.means + 3 * begin, 3, 3, group.count, group.mean);
  load_columns(g.scales + 3 * begin, 3, 3, group.count, group.scale);
  load_columns(g.quaternions + 4 * begin, 4, 4, group.count, group.unit);
  load_columns(g.opacities + begin, 1, 1, group.count, &group.opacity);
  group.log2_opacity = log2_of<T>(group.opacity);

  // Scaling by a power of two is exact, and keeps squares from overflowing and underflowing.
  V* q = group.unit;
  group.power = inverse_power_of_two<T>(larger(larger(magnitude(q[0]), magnitude(q[1])), larger(magnitude(q[2]), magnitude(q[3]))));
  for (int k = 0; k < 4; ++k) q[k] *= group.power;
  group.inverse_norm = T(1) / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int k = 0; k < 4; ++k) q[k] *= group.inverse_norm;
  const V w = q[0], x = q[1], y = q[2], z = q[3];
  V* r = group.rotation;
  r[0] = T(1) - T(2) * (y * y + z * z);
  r[1] = T(2) * (x * y - w * z);
  r[2] = T(2) * (x * z + w * y);
  r[3] = T(2) * (x * y + w * z);
  r[4] = T(1) - T(2) * (x * x + z * z);
  r[5] = T(2) * (y * z - w * x);
  r[6] = T(2) * (x * z - w * y);
  r[7] = T(2) * (y * z + w * x);
  r[8] = T(1) - T(2) * (x * x + y * y);
  for (int k = 0; k < 9; ++k) group.axes[k] = r[k] * group.scale[k % 3];
}

template <class T>
GS_INLINE void load_group(const Gaussians<T>& g, int64_t begin, int64_t end, Group<T>& group) {
  load_shapes(g, begin, end, group);
  load_columns(g.sh + int64_t(3) * g.bases * begin, 3 * g.bases, 3 * g.bases, group.count, group.sh);
}

// Projects a group. A NaN anywhere in a Gaussian's geometry makes it invisible.
template <class T>
GS_INLINE void project_group(const Group<T>& g, const ProjectionParams<T>& params, Projection<T>& p) {
  using V = Vector<T>;
  const Camera<T>& c = params.camera;
  const V largest = broadcast<T>(sizeof(T) == 4 ? T(3e38) : T(1e308)), zero{};
  for (int r = 0; r < 3; ++r)
    p.t[r] = c.rotation[3 * r] * g.mean[0] + c.rotation[3 * r + 1] * g.mean[1] + c.rotation[3 * r + 2] * g.mean[2] +
             c.translation[r];
  p.visible = both(less(broadcast<T>(params.near_plane), p.t[2]), less_equal(broadcast<T>(T(kMinAlpha)), g.opacity));
  p.visible = both(p.visible, less(p.t[2], broadcast<T>(params.far_plane)));
  if (!any(p.visible)) return;

  p.inverse_z = T(1) / p.t[2];
  const V x = p.t[0] * p.inverse_z, y = p.t[1] * p.inverse_z;
  const V x_low = broadcast<T>(params.x_low), x_high = broadcast<T>(params.x_high);
  const V y_low = broadcast<T>(params.y_low), y_high = broadcast<T>(params.y_high);
  p.a = clamp(x, x_low, x_high);
  p.b = clamp(y, y_low, y_high);
  p.is_a_unclamped = both(less_equal(x_low, x), less_equal(x, x_high));
  p.is_b_unclamped = both(less_equal(y_low, y), less_equal(y, y_high));
  for (int r = 0; r < 3; ++r)
    for (int k = 0; k < 3; ++k)
      p.wrs[3 * r + k] = c.rotation[3 * r] * g.axes[k] + c.rotation[3 * r + 1] * g.axes[3 + k] +
                         c.rotation[3 * r + 2] * g.axes[6 + k];
  const V fx = c.fx * p.inverse_z, fy = c.fy * p.inverse_z;
  for (int k = 0; k < 3; ++k) {
    p.jwrs[k] = fx * (p.wrs[k] - p.a * p.wrs[6 + k]);
    p.jwrs[3 + k] = fy * (p.wrs[3 + k] - p.b * p.wrs[6 + k]);
  }
  const V* h = p.jwrs;
  p.cov_xx = h[0] * h[0] + h[1] * h[1] + h[2] * h[2] + params.eps2d;
  p.cov_xy = h[0] * h[3] + h[1] * h[4] + h[2] * h[5];
  p.cov_yy = h[3] * h[3] + h[4] * h[4] + h[5] * h[5] + params.eps2d;
  // det(H Hᵀ + εI) = |h₁ × h₂|² + ε (tr + ε): no cancellation for needles, unlike xx·yy − xy².
  p.normal[0] = h[1] * h[5] - h[2] * h[4];
  p.normal[1] = h[2] * h[3] - h[0] * h[5];
  p.normal[2] = h[0] * h[4] - h[1] * h[3];
  p.normal2 = p.normal[0] * p.normal[0] + p.normal[1] * p.normal[1] + p.normal[2] * p.normal[2];
  p.determinant = p.normal2 + params.eps2d * (p.cov_xx + p.cov_yy - params.eps2d);
  p.visible = both(p.visible, both(less(zero, p.determinant), less_equal(p.determinant, largest)));

  // Half the inverse is [[a², ab], [ab, b² + c²]]: 2a² = Σ_yy/det, and 2c² = 1/Σ_yy, because the Schur complement of an inverse is the
  // inverse of an entry. The factor log₂e converts exponents to base 2.
  constexpr T scale = T(0.5 * kLog2E);
  p.factor_a = sqrt(scale * p.cov_yy / p.determinant);
  p.factor_b = -p.factor_a * p.cov_xy / p.cov_yy;
  p.factor_c = sqrt(scale / p.cov_yy);
  p.visible = both(p.visible, both(less(zero, p.factor_a), less(zero, p.factor_c)));
  p.log2_opacity = g.log2_opacity;
  if (params.antialiased) {
    const V opacity = g.opacity * sqrt(p.normal2 / p.determinant);
    p.visible = both(p.visible, less_equal(broadcast<T>(T(kMinAlpha)), opacity));
    p.log2_opacity = log2_of<T>(opacity);
  }
  const V u = c.fx * x, v = c.fy * y;
  p.visible = both(p.visible, both(less_equal(u * u, largest), less_equal(v * v, largest)));
}

// Computes the fields of Splat, in its order, for all lanes.
template <class T>
GS_INLINE void make_splats(const ProjectionParams<T>& params, const Projection<T>& p, const Shading<T>& s,
                           Vector<T> out[16]) {
  using V = Vector<T>;
  const V zero{}, a = p.factor_a, b = p.factor_b, c = p.factor_c;
  const auto clamped = [&](V color) { return params.direct_colors ? color : larger(zero, color); };  // NaN stays NaN
  // α ≥ 1/255 ⟺ s ≤ log₂(255·opacity). The margin covers the rounding of s, whose terms may exceed s itself: at the rim of a splat by 1 +
  // |b|/c.
  const V exact = p.log2_opacity + T(kLog2Of255), skew = magnitude(b) / c;
  constexpr T rounding = sizeof(T) == 4 ? T(1e-6) : T(1e-15);
  const V reach = exact + T(1e-3) * (T(1) + exact) + rounding * exact * (T(1) + skew);
  const V radius = sqrt(reach), bb_cc = b * b + c * c;
  const V numbers[16] = {params.camera.fx * (p.t[0] * p.inverse_z) + params.camera.cx,
                         params.camera.fy * (p.t[1] * p.inverse_z) + params.camera.cy,
                         a,
                         b,
                         c,
                         p.log2_opacity,
                         clamped(s.color[0]),
                         clamped(s.color[1]),
                         clamped(s.color[2]),
                         select(p.visible, p.t[2], zero),
                         reach,
                         radius * sqrt(bb_cc) / (a * c) * T(1 + 1e-5) + T(1e-3),
                         radius / c * T(1 + 1e-5) + T(1e-3),
                         b / a,
                         a * b / bb_cc,
                         zero};
  for (int k = 0; k < 16; ++k) out[k] = numbers[k];
}

// Computes directions and basis functions, without colors. Lanes in which `visible` is false get a direction of zero.
template <class T>
GS_INLINE void compute_directions(const Group<T>& g, int bases, const ProjectionParams<T>& params, Mask<T> visible, Shading<T>& s) {
  using V = Vector<T>;
  V distance2{};
  for (int k = 0; k < 3; ++k) {
    s.direction[k] = select(visible, g.mean[k] - params.center[k], V{});
    distance2 += s.direction[k] * s.direction[k];
  }
  s.inverse_distance = select(visible, T(1) / sqrt(distance2), V{});
  for (int k = 0; k < 3; ++k) s.direction[k] *= s.inverse_distance;
  sh_basis<T>(bases, s.direction, s.basis);
  if (params.direct_colors) s.basis[0] = broadcast<T>(T(1));
}

template <class T>
GS_INLINE void shade_group(const Group<T>& g, int bases, const ProjectionParams<T>& params, Mask<T> visible, Shading<T>& s) {
  compute_directions(g, bases, params, visible, s);
  for (int channel = 0; channel < 3; ++channel) {
    s.color[channel] = broadcast<T>(T(params.direct_colors ? 0 : 0.5));
    for (int k = 0; k < bases; ++k) s.color[channel] = fma(s.basis[k], g.sh[3 * k + channel], s.color[channel]);
  }
}

// Projects Gaussians begin … end − 1 into each of `views` cameras: splats[view][i].
template <class T>
void project(const Gaussians<T>& g, int64_t begin, int64_t end, const ProjectionParams<T>* params, int64_t views,
             Splat<T>* const* splats) {
  static_assert(sizeof(Splat<T>) == 16 * sizeof(T));
  for (int64_t i = begin; i < end; i += Simd<T>::lanes) {
    Group<T> group;
    load_group(g, i, end, group);
    for (int64_t view = 0; view < views; ++view) {
      Projection<T> projection;
      Shading<T> shading;
      Vector<T> numbers[16] = {};
      project_group(group, params[view], projection);
      if (any(projection.visible)) {
        shade_group(group, g.bases, params[view], projection.visible, shading);
        make_splats(params[view], projection, shading, numbers);
      }
      store_columns(numbers, 16, group.count, &splats[view][i].u);
    }
  }
}

// Gradients of a group's Gaussians, summed over cameras, with respect to R S instead of scales and quaternions.
template <class T>
struct GroupGradient {
  Vector<T> mean[3] = {}, axes[9] = {}, opacity = {}, sh[kMaxBases * 3] = {};
};

// Computes the gradients that one camera's pixel sums `d` give to the Gaussians' spherical harmonics, whose element n is coefficient(n),
// and to their means through the direction, which are stored in d_r. `is_lit` is true for channels that aren't clamped at 0.
// add_product_to(n, x, y) is called to add x·y to the gradient of element n, after all coefficients have been read.
template <class T, class Coefficient, class AddProductTo>
GS_INLINE void shade_group_backward(int bases, const Shading<T>& s, const Mask<T> (&is_lit)[3],
                                    const Vector<T> d[kSplatGradientNumbers], const Coefficient& coefficient,
                                    const AddProductTo& add_product_to, Vector<T> d_r[3]) {
  using V = Vector<T>;
  const V zero{};
  // Gradient of the mean through the direction: d = r/‖r‖, ∂d/∂r = (I − d dᵀ)/‖r‖.
  V d_color[3], d_basis[kMaxBases], d_direction[3];
  for (int channel = 0; channel < 3; ++channel) d_color[channel] = select(is_lit[channel], d[6 + channel], zero);
  for (int k = 0; k < bases; ++k) {
    d_basis[k] = zero;
    for (int channel = 0; channel < 3; ++channel)
      d_basis[k] = add_product(coefficient(3 * k + channel), d_color[channel], d_basis[k]);
  }
  for (int k = 0; k < bases; ++k)
    for (int channel = 0; channel < 3; ++channel) add_product_to(3 * k + channel, s.basis[k], d_color[channel]);
  sh_basis_backward<T>(bases, s.direction, d_basis, d_direction);
  const V along = d_direction[0] * s.direction[0] + d_direction[1] * s.direction[1] + d_direction[2] * s.direction[2];
  for (int k = 0; k < 3; ++k) d_r[k] = (d_direction[k] - along * s.direction[k]) * s.inverse_distance;
}

// Adds the gradients that one camera's pixel sums `d` give to the Gaussians, except for spherical harmonics, in lanes in which `touched` is
// true; in other lanes `d` and `d_r` are 0. `d_mean2d` receives the gradient of the projected means. If `of_cameras` is set, `of_camera`
// receives the gradient of the camera from each lane, in CameraGradient's order.
template <class T>
GS_INLINE void project_group_backward(const Group<T>& g, const ProjectionParams<T>& params, const Projection<T>& p, Mask<T> touched,
                                      const Vector<T> d[kSplatGradientNumbers], const Vector<T> d_r[3],
                                      GroupGradient<T>& out, Vector<T> d_mean2d[2], bool of_cameras,
                                      Vector<T> of_camera[kCameraNumbers]) {
  using V = Vector<T>;
  const V zero{};
  const V power = d[0], power_p = d[1], power_r = d[2], power_pp = d[3], power_pr = d[4], power_rr = d[5];
  const auto add = [&](V& to, V value) { to += select(touched, value, zero); };

  // α = opacity·ρ·e^{−σ} and ν = −α ∂L/∂α, so ∂L/∂opacity = −Σν / opacity, and ∂L/∂(ln ρ) = −Σν.
  add(out.opacity, -power / g.opacity);
  for (int k = 0; k < 3; ++k) add(out.mean[k], d_r[k]);

  // With U = [[a, b], [0, c]], σ = ln 2·|UΔ|² and Σ2D⁻¹ = 2 ln 2·UᵀU. From M = Σ ν UΔ and W = Σ ν (UΔ)(UΔ)ᵀ,
  // ∂L/∂(u, v) = 2 ln 2·UᵀM and ∂L/∂Σ2D = −2 ln²2·UᵀWU.
  constexpr T ln2 = T(1 / kLog2E), two_ln2 = 2 * ln2, two_ln2_squared = two_ln2 * ln2;
  const V a = p.factor_a, b = p.factor_b, c = p.factor_c;
  const V d_u = two_ln2 * a * power_p;
  const V d_v = two_ln2 * (b * power_p + c * power_r);
  d_mean2d[0] = select(touched, d_u, zero);
  d_mean2d[1] = select(touched, d_v, zero);
  V m_xx = -two_ln2_squared * a * a * power_pp;
  V m_xy = -two_ln2_squared * a * (b * power_pp + c * power_pr);
  V m_yy = -two_ln2_squared * (b * b * power_pp + T(2) * b * c * power_pr + c * c * power_rr);
  if (params.antialiased) {
    // ln ρ = ½ ln det(H Hᵀ) − ½ ln det Σ2D. The second term gives ∂L/∂Σ2D another ½ Σν Σ2D⁻¹.
    m_xx += ln2 * power * a * a;
    m_xy += ln2 * power * a * b;
    m_yy += ln2 * power * (b * b + c * c);
  }

  // Σ2D = H Hᵀ + εI: ∂L/∂H = 2 (∂L/∂Σ2D) H;  H = J V with V = W R S.
  const Camera<T>& camera = params.camera;
  const V fx = camera.fx * p.inverse_z, fy = camera.fy * p.inverse_z;
  V d_jwrs[6], d_wrs[9];
  V d_fx{}, d_fy{}, d_a{}, d_b{};  // with respect to f_x/z, f_y/z, a, b
  for (int k = 0; k < 3; ++k) {
    d_jwrs[k] = T(2) * (m_xx * p.jwrs[k] + m_xy * p.jwrs[3 + k]);
    d_jwrs[3 + k] = T(2) * (m_xy * p.jwrs[k] + m_yy * p.jwrs[3 + k]);
  }
  if (params.antialiased) {
    // det(H Hᵀ) = |n|² with n = h₁ × h₂: its gradients are 2 h₂ × n and 2 n × h₁.
    const V* n = p.normal;
    const V d_normal = -power / p.normal2;
    for (int k = 0; k < 3; ++k) {
      const int i = (k + 1) % 3, j = (k + 2) % 3;
      d_jwrs[k] += d_normal * (p.jwrs[3 + i] * n[j] - p.jwrs[3 + j] * n[i]);
      d_jwrs[3 + k] += d_normal * (n[i] * p.jwrs[j] - n[j] * p.jwrs[i]);
    }
  }
  for (int k = 0; k < 3; ++k) {
    d_wrs[k] = fx * d_jwrs[k];
    d_wrs[3 + k] = fy * d_jwrs[3 + k];
    d_wrs[6 + k] = -fx * p.a * d_jwrs[k] - fy * p.b * d_jwrs[3 + k];
    d_fx += d_jwrs[k] * (p.wrs[k] - p.a * p.wrs[6 + k]);
    d_fy += d_jwrs[3 + k] * (p.wrs[3 + k] - p.b * p.wrs[6 + k]);
    d_a -= fx * d_jwrs[k] * p.wrs[6 + k];
    d_b -= fy * d_jwrs[3 + k] * p.wrs[6 + k];
  }

  // t_x/z affects u always, and a if it isn't clamped.
  const V d_x = camera.fx * d_u + select(p.is_a_unclamped, d_a, zero);
  const V d_y = camera.fy * d_v + select(p.is_b_unclamped, d_b, zero);
  const V inverse_z2 = p.inverse_z * p.inverse_z;
  const V d_t[3] = {d_x * p.inverse_z, d_y * p.inverse_z,
                    d[9] - (d_x * p.t[0] + d_y * p.t[1]) * inverse_z2 - (d_fx * camera.fx + d_fy * camera.fy) * inverse_z2};
  const T* w = camera.rotation;
  for (int k = 0; k < 3; ++k) add(out.mean[k], w[k] * d_t[0] + w[3 + k] * d_t[1] + w[6 + k] * d_t[2]);
  for (int r = 0; r < 3; ++r)
    for (int k = 0; k < 3; ++k)
      add(out.axes[3 * r + k], w[r] * d_wrs[k] + w[3 + r] * d_wrs[3 + k] + w[6 + r] * d_wrs[6 + k]);

  // t = W μ + p, V = W (R S), and r = μ − o with o = −Wᵀ p.
  if (!of_cameras) return;
  for (int r = 0; r < 3; ++r) {
    for (int k = 0; k < 3; ++k)
      of_camera[3 * r + k] =
          select(touched,
                 d_t[r] * g.mean[k] + d_wrs[3 * r] * g.axes[3 * k] + d_wrs[3 * r + 1] * g.axes[3 * k + 1] +
                     d_wrs[3 * r + 2] * g.axes[3 * k + 2] + camera.translation[r] * d_r[k],
                 zero);
    of_camera[9 + r] = select(touched, d_t[r] + w[3 * r] * d_r[0] + w[3 * r + 1] * d_r[1] + w[3 * r + 2] * d_r[2], zero);
  }
}

// Converts ∂L/∂(R S) to gradients of scales and quaternions, which affect pixels in no other way.
template <class T>
GS_INLINE void axes_backward(const Group<T>& g, const Vector<T> d_axes[9], Vector<T> d_scale[3],
                             Vector<T> d_quaternion[4]) {
  using V = Vector<T>;
  V r[9];  // ∂L/∂R
  for (int k = 0; k < 3; ++k) d_scale[k] = V{};
  for (int k = 0; k < 9; ++k) {
    d_scale[k % 3] += d_axes[k] * g.rotation[k];
    r[k] = d_axes[k] * g.scale[k % 3];
  }
  // Gradient of R with respect to the unit quaternion, then of the normalization: ∂/∂q = (I − q̂ q̂ᵀ)/‖q‖.
  const V w = g.unit[0], x = g.unit[1], y = g.unit[2], z = g.unit[3];
  const V d_unit[4] = {T(2) * (x * (r[7] - r[5]) + y * (r[2] - r[6]) + z * (r[3] - r[1])),
                       T(2) * (w * (r[7] - r[5]) + y * (r[1] + r[3]) + z * (r[2] + r[6]) - T(2) * x * (r[4] + r[8])),
                       T(2) * (w * (r[2] - r[6]) + x * (r[1] + r[3]) + z * (r[5] + r[7]) - T(2) * y * (r[0] + r[8])),
                       T(2) * (w * (r[3] - r[1]) + x * (r[2] + r[6]) + y * (r[5] + r[7]) - T(2) * z * (r[0] + r[4]))};
  const V inward = d_unit[0] * w + d_unit[1] * x + d_unit[2] * y + d_unit[3] * z;
  for (int k = 0; k < 4; ++k) d_quaternion[k] = (d_unit[k] - inward * g.unit[k]) * g.inverse_norm * g.power;
}

// Sums the records of Gaussian `first` and those after it in order, one Gaussian per lane. Returns which lanes have any.
template <class T>
GS_INLINE Mask<T> sum_records(const SplatRecords<T>& from, int64_t first, int count,
                              Vector<T> out[kSplatGradientNumbers]) {
  constexpr int lanes = Simd<T>::lanes, parts = (kSplatGradientNumbers + lanes - 1) / lanes;
  T sums[lanes][parts * lanes], has_any[lanes] = {};
  for (int lane = 0; lane < lanes; ++lane) {
    Vector<T> sum[parts] = {};
    const uint32_t begin = lane < count ? from.first[first + lane] : 0, end = lane < count ? from.first[first + lane + 1] : 0;
    for (uint32_t r = begin; r < end; ++r)
      for (int k = 0; k < parts; ++k)
        sum[k] += load_partial<T>(&from.records[r].power + k * lanes, kSplatGradientNumbers - k * lanes);
    for (int k = 0; k < parts; ++k) store<T>(sums[lane] + k * lanes, sum[k]);
    has_any[lane] = T(begin < end);
  }
  load_columns(sums[0], parts * lanes, kSplatGradientNumbers, lanes, out);
  return less(Vector<T>{}, load<T>(has_any));
}

// Computes all gradients of Gaussians begin … end − 1 from the pixel sums of `views` cameras. If `cameras` isn't null, their gradients of the
// cameras are added to it.
template <class T>
void project_backward(const Gaussians<T>& g, int64_t begin, int64_t end, const ProjectionParams<T>* params, int64_t views,
                      const SplatRecords<T>* records, const GaussianGradients<T>& out, CameraGradient<T>* cameras) {
  using V = Vector<T>;
  for (int64_t i = begin; i < end; i += Simd<T>::lanes) {
    Group<T> group;
    load_group(g, i, end, group);
    GroupGradient<T> sum;
    Mask<T> ever{};
    for (int64_t view = 0; view < views; ++view) {
      V d[kSplatGradientNumbers], d_mean2d[2] = {}, of_camera[kCameraNumbers] = {};
      const Mask<T> touched = sum_records(records[view], i, group.count, d);
      if (any(touched)) {
        ever = Mask<T>(ever | touched);
        Projection<T> projection;
        Shading<T> shading;
        project_group(group, params[view], projection);
        if (any(projection.visible)) {  // all Gaussians with records are visible
          shade_group(group, g.bases, params[view], touched, shading);
          const auto is_unclamped = [&](V color) { return params[view].direct_colors ? touched : less(V{}, color); };
          const Mask<T> is_lit[3] = {is_unclamped(shading.color[0]), is_unclamped(shading.color[1]), is_unclamped(shading.color[2])};
          V d_r[3];
          shade_group_backward<T>(
              g.bases, shading, is_lit, d, [&](int n) { return group.sh[n]; },
              [&](int n, V x, V y) { sum.sh[n] = add_product(x, y, sum.sh[n]); }, d_r);
          project_group_backward(group, params[view], projection, touched, d, d_r, sum, d_mean2d, cameras != nullptr, of_camera);
        }
      }
      if (out.means2d != nullptr) store_columns(d_mean2d, 2, group.count, out.means2d + 2 * (view * g.count + i));
      if (cameras != nullptr) {
        T numbers[kCameraNumbers];
        sum_each<T>(of_camera, numbers);
        for (int k = 0; k < kCameraNumbers; ++k) cameras[view].numbers[k] += numbers[k];
      }
    }
    V d_scale[3], d_quaternion[4];
    axes_backward(group, sum.axes, d_scale, d_quaternion);
    for (V& v : d_scale) v = select(ever, v, V{});
    for (V& v : d_quaternion) v = select(ever, v, V{});
    store_columns(sum.mean, 3, group.count, out.means + 3 * i);
    store_columns(d_scale, 3, group.count, out.scales + 3 * i);
    store_columns(d_quaternion, 4, group.count, out.quaternions + 4 * i);
    store_columns(&sum.opacity, 1, group.count, out.opacities + i);
    store_columns(sum.sh, 3 * g.bases, group.count, out.sh + int64_t(3) * g.bases * i);
  }
}

}  // namespace globalsplat::raster::GS_ISA
