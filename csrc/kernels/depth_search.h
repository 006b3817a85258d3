// Search for the depths of a photo's pixels by comparison with other photos. It runs in parallel, and its results are bit-identical for any
// number of threads.
#pragma once

#include "types.h"

namespace globalsplat::raster {

// Searches the planes with the inverse depths 0, step, …, (planes − 1) · step (plane_sweep.h). Writes the best inverse depth of each pixel
// and its score, both [H, W].
void search_depths(const PlaneSweep& sweep, int planes, float* inverse_depth, float* score, int num_threads);

// Searches them by semi-global matching (semi_global.h). Writes the inverse depth of each pixel and how sure it is, in [0, 1], both [H, W].
void match_semi_globally(const PlaneSweep& sweep, int planes, float* inverse_depth, float* sureness, int num_threads);

}  // namespace globalsplat::raster
