// Losses that fit rendered images to photos, with gradients: photometric distance and depth smoothness. They run in parallel, and their
// results are bit-identical for any number of threads.
#pragma once

#include <cstdint>

#include "types.h"

namespace globalsplat::raster {

// Rendered images and the photos to compare them with: `planes` planes [H, W] each. Both sides have at least 11 pixels.
template <class T>
struct PhotometricJob {
  const T* pictures;
  const T* photos;
  int64_t planes;
  int width, height;
};

// Computes `l1_weight` · mean |x − y| + `ssim_weight` · mean SSIM. Means are over all planes and over pixels, or windows that lie inside
// (spec 9.4). Writes the gradient with respect to the images, [planes, H, W], if it isn't null.
template <class T>
double photometric(const PhotometricJob<T>& job, double l1_weight, double ssim_weight, T* gradient, int num_threads);

// Returns the weights of SSIM's window in each direction, [11].
template <class T>
const T* ssim_window();

// Computes `factor` · the mean unevenness of depths (unevenness.h) over all pairs of neighbouring pixels. Writes the gradient with respect
// to the depths, [views, H, W], if `gradient` isn't null.
template <class T>
double depth_smoothness(const SmoothnessJob<T>& job, double factor, T* gradient, int num_threads);

}  // namespace globalsplat::raster
