// Camera parameters that all Gaussians of a view share.
#pragma once

#include "types.h"

namespace globalsplat::raster {

// Converts the rows of w2c, 4×4, and of the intrinsics, 3×3 in pixels, to a camera.
template <class T>
inline Camera<T> camera_of(const T* w2c, const T* intrinsics) {
  const T *m = w2c, *k = intrinsics;
  return {{m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]}, {m[3], m[7], m[11]}, k[0], k[4], k[2], k[5]};
}

template <class T>
inline ProjectionParams<T> make_projection_params(const Camera<T>& camera, int width, int height, const ProjectionSettings& settings) {
  ProjectionParams<T> params{camera, width, height, T(settings.eps2d), T(settings.near_plane), T(settings.far_plane),
                             settings.antialiased, settings.direct_colors, {}, 0, 0, 0, 0};
  const T *r = camera.rotation, *t = camera.translation;
  for (int k = 0; k < 3; ++k) params.center[k] = -(r[k] * t[0] + r[3 + k] * t[1] + r[6 + k] * t[2]);
  const T margin_x = T(kJacobianMargin) * width / camera.fx, margin_y = T(kJacobianMargin) * height / camera.fy;
  params.x_low = -camera.cx / camera.fx - margin_x;
  params.x_high = (width - camera.cx) / camera.fx + margin_x;
  params.y_low = -camera.cy / camera.fy - margin_y;
  params.y_high = (height - camera.cy) / camera.fy + margin_y;
  return params;
}

}  // namespace globalsplat::raster
