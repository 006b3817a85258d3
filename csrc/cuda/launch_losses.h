// Losses of images and depths compared to photos, on a GPU: the counterpart of ../kernels/image_losses.h, in float32, as a sequence of
// kernels.
#pragma once

#include "../kernels/image_losses.h"
#include "device.h"

namespace globalsplat::cuda {

// Partial sums on the device, whose total is a result.
struct PartialSums {
  Memory numbers;  // double[count]
  int64_t count;
};

// Compute raster::photometric() and raster::depth_smoothness(); addresses are in the device's memory.
PartialSums photometric(const Device&, const raster::PhotometricJob<float>&, double l1_weight, double ssim_weight, float* gradient);
PartialSums depth_smoothness(const Device&, const raster::SmoothnessJob<float>&, double factor, float* gradient);

}  // namespace globalsplat::cuda
