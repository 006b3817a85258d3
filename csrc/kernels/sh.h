// Real spherical harmonics up to degree 3, with the constants and signs of the original 3DGS release
// (Kerbl et al. 2023; spec 6.3): Y_0 = 0.28209479, Y_1 = 0.48860251·(−y, z, −x), …
//
// T is a scalar type; V is the type of the computation: T itself or a vector of T.
#pragma once

namespace globalsplat::raster {

inline constexpr int kMaxBases = 16;

namespace sh {
inline constexpr double c0 = 0.28209479177387814;
inline constexpr double c1 = 0.4886025119029199;
inline constexpr double c2[5] = {1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792,
                                 0.5462742152960396};
inline constexpr double c3[7] = {-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
                                 -0.4570457994644658, 1.445305721320277,  -0.5900435899266435};
}  // namespace sh

// Evaluates Y_b(d) for the first `bases` functions; d = (x, y, z) is a unit vector.
template <class T, class V>
inline __attribute__((always_inline)) void sh_basis(int bases, const V d[3], V out[kMaxBases]) {
  using namespace sh;
  const V x = d[0], y = d[1], z = d[2];
  out[0] = V{} + T(c0);
  if (bases <= 1) return;
  out[1] = T(-c1) * y;
  out[2] = T(c1) * z;
  out[3] = T(-c1) * x;
  if (bases <= 4) return;
  const V xx = x * x, yy = y * y, zz = z * z;
  out[4] = T(c2[0]) * x * y;
  out[5] = T(c2[1]) * y * z;
  out[6] = T(c2[2]) * (T(2) * zz - xx - yy);
  out[7] = T(c2[3]) * x * z;
  out[8] = T(c2[4]) * (xx - yy);
  if (bases <= 9) return;
  out[9] = T(c3[0]) * y * (T(3) * xx - yy);
  out[10] = T(c3[1]) * x * y * z;
  out[11] = T(c3[2]) * y * (T(4) * zz - xx - yy);
  out[12] = T(c3[3]) * z * (T(2) * zz - T(3) * xx - T(3) * yy);
  out[13] = T(c3[4]) * x * (T(4) * zz - xx - yy);
  out[14] = T(c3[5]) * z * (xx - yy);
  out[15] = T(c3[6]) * x * (xx - T(3) * yy);
}

// Computes Σ_b g_b ∂Y_b/∂d, with the polynomials as functions on all of space.
template <class T, class V>
inline __attribute__((always_inline)) void sh_basis_backward(int bases, const V d[3], const V g[kMaxBases], V out[3]) {
  using namespace sh;
  const V x = d[0], y = d[1], z = d[2];
  V dx{}, dy{}, dz{};
  if (bases > 1) {
    dy += T(-c1) * g[1];
    dz += T(c1) * g[2];
    dx += T(-c1) * g[3];
  }
  if (bases > 4) {
    dx += T(c2[0]) * y * g[4] - T(2 * c2[2]) * x * g[6] + T(c2[3]) * z * g[7] + T(2 * c2[4]) * x * g[8];
    dy += T(c2[0]) * x * g[4] + T(c2[1]) * z * g[5] - T(2 * c2[2]) * y * g[6] - T(2 * c2[4]) * y * g[8];
    dz += T(c2[1]) * y * g[5] + T(4 * c2[2]) * z * g[6] + T(c2[3]) * x * g[7];
  }
  if (bases > 9) {
    const V xx = x * x, yy = y * y, zz = z * z;
    dx += T(6 * c3[0]) * x * y * g[9] + T(c3[1]) * y * z * g[10] - T(2 * c3[2]) * x * y * g[11] -
          T(6 * c3[3]) * x * z * g[12] + T(c3[4]) * (T(4) * zz - T(3) * xx - yy) * g[13] + T(2 * c3[5]) * x * z * g[14] +
          T(3 * c3[6]) * (xx - yy) * g[15];
    dy += T(3 * c3[0]) * (xx - yy) * g[9] + T(c3[1]) * x * z * g[10] + T(c3[2]) * (T(4) * zz - xx - T(3) * yy) * g[11] -
          T(6 * c3[3]) * y * z * g[12] - T(2 * c3[4]) * x * y * g[13] - T(2 * c3[5]) * y * z * g[14] -
          T(6 * c3[6]) * x * y * g[15];
    dz += T(c3[1]) * x * y * g[10] + T(8 * c3[2]) * y * z * g[11] + T(c3[3]) * (T(6) * zz - T(3) * xx - T(3) * yy) * g[12] +
          T(8 * c3[4]) * x * z * g[13] + T(c3[5]) * (xx - yy) * g[14];
  }
  out[0] = dx;
  out[1] = dy;
  out[2] = dz;
}

}  // namespace globalsplat::raster
