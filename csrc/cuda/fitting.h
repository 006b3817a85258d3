// Losses that fit rendered images to photos on a GPU: the counterpart of ../kernels/fit.h, in float32, as a sequence of kernels.
#pragma once

#include "../kernels/fit.h"
#include "device.h"

namespace globalsplat::cuda {

// Partial sums on the device, whose total is a result.
struct Parts {
  Memory numbers;  // double[count]
  int64_t count;
};

// Compute raster::photometric() and raster::depth_smoothness(); addresses are in the device's memory.
Parts photometric(const Device&, const raster::FitJob<float>&, double l1_weight, double ssim_weight, float* gradient);
Parts depth_smoothness(const Device&, const raster::DepthJob<float>&, double factor, float* gradient);

}  // namespace globalsplat::cuda
