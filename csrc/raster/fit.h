// What fitting pictures to photos needs beside drawing them: how far they are apart, and how uneven depths are, with gradients.
// Shared among threads; the bits don't depend on their number.
#pragma once

#include <cstdint>

#include "types.h"

namespace globalsplat::raster {

// Pictures and photos: planes [H, W], both sides at least 11.
template <class T>
struct FitJob {
  const T* pictures;
  const T* photos;
  int64_t planes;
  int width, height;
};

// `absolute` · mean |x − y| + `similar` · mean SSIM, means over all planes and pixels, or windows that lie inside (spec 9.4).
// Writes the gradient with respect to the pictures, [planes, H, W], if it isn't null.
template <class T>
double photometric(const FitJob<T>& job, double absolute, double similar, T* gradient, int threads);

// The weights of SSIM's window in each direction, [11].
template <class T>
const T* ssim_window();

// `factor` · the mean over all pairs of neighbouring pixels of how uneven depths are there; see smooth.h. Writes the gradient with
// respect to the depths, [views, H, W], if it isn't null.
template <class T>
double depth_smoothness(const DepthJob<T>& job, double factor, T* gradient, int threads);

}  // namespace globalsplat::raster
