// Search for the depths of a photo by comparison with others, on torch tensors. Rust calls it through cxx.
#pragma once

#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

struct PhotoToCompare;

// Computes the inverse depth at which each pixel of `grey` looks most alike in the other photos, and its score there
// (kernels/plane_sweep.h). Candidates are the multiples 0 to `planes` − 1 of `step`. Arguments are addresses of live tensors [H, W], both
// sides at least 9; the address of a weight is 0 if every pixel counts. `out` receives two new tensors [H, W] that the caller owns, float32
// on the CPU. Throws on shapes that don't fit.
void search_depths(size_t grey, size_t weight, rust::Slice<const PhotoToCompare> others, float step, int32_t planes,
                   rust::Slice<size_t> out);

// Does the same by semi-global matching (kernels/semi_global.h). `out` receives the inverse depth and how sure it is, in [0, 1].
void match_semi_globally(size_t grey, size_t weight, rust::Slice<const PhotoToCompare> others, float step, int32_t planes,
                         rust::Slice<size_t> out);

}  // namespace globalsplat
