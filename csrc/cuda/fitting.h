// What fitting pictures to photos needs on a device: what ../raster/fit.h is on the CPU, in float32, kernel after kernel.
#pragma once

#include "../raster/fit.h"
#include "device.h"

namespace globalsplat::cuda {

// Numbers on the device whose sum is a result.
struct Parts {
  Memory numbers;  // double[count]
  int64_t count;
};

// As raster::photometric(), and raster::depth_smoothness(); addresses are of the device's memory.
Parts photometric(const Device&, const raster::FitJob<float>&, double absolute, double similar, float* gradient);
Parts depth_smoothness(const Device&, const raster::DepthJob<float>&, double factor, float* gradient);

}  // namespace globalsplat::cuda
