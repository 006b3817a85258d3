// The kernels that exist once per instruction set, and the choice among them.
#pragma once

#include "types.h"

namespace globalsplat::raster {

template <class T>
struct BlendKernels {
  void (*forward)(const TileJob<T>&, const Pictures<T>&);
  void (*backward)(const TileJob<T>&, const Pictures<const T>& pictures, const Pictures<const T>& gradients,
                   SplatGradient<T>* records);
};

struct Kernels {
  const char* name;  // "avx512", "avx2", "neon", "portable"
  BlendKernels<float> blend32;
  BlendKernels<double> blend64;
};

// The best that this machine runs, or the one GLOBALSPLAT_SIMD names. Throws std::invalid_argument when it names one
// that this machine or build doesn't have.
const Kernels& kernels();

}  // namespace globalsplat::raster
