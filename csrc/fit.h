// What fitting pictures to photos needs beside drawing them, on torch tensors, as Rust calls it through cxx.
#pragma once

#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

struct AdamArguments;  // shared with Rust, see src/fit.rs

// `absolute` · mean |picture − photo| + `similar` · mean SSIM (spec 9.4), of two tensors [.., H, W] of one shape, both sides at
// least 11; addresses of live tensors. `out` receives a new scalar tensor that the caller owns, on the picture's device, float64
// where the picture is and float32 else. Differentiable with respect to the picture. Throws on shapes that don't fit.
void photometric(size_t picture, size_t photo, double absolute, double similar, rust::Slice<size_t> out);

// `factor` · how uneven depths are where photos are even (raster/smooth.h), of depths [.., H, W] and photos [.., 3, H, W]. As
// photometric() else; differentiable with respect to the depths.
void depth_smoothness(size_t depths, size_t photos, double factor, rust::Slice<size_t> out);

// Updates a tensor and its moments in place, without the knowledge of autograd. All four on the CPU, contiguous, of one shape and
// type, float32 or float64; throws where they aren't.
void adam(const AdamArguments& of);

}  // namespace globalsplat
