// Image losses, depth search and optimizer steps, on several threads. Results are bit-identical for any number of threads.
#pragma once

#include <cstdint>
#include <vector>

#include "types.h"

namespace globalsplat::raster {

// ---- losses that fit rendered images to photos, with gradients ----

// Computes `l1_weight` · mean |x − y| + `ssim_weight` · mean SSIM of images and photos of the same shape, both sides at least 11. Means are over
// all planes and over pixels, or windows that lie inside (spec 9.4). Writes the gradient with respect to the images if it isn't null.
template <class T>
double photometric(const LossJob<T>& job, double l1_weight, double ssim_weight, T* gradient, int num_threads);

// Returns the weights of SSIM's window in each direction, [11].
template <class T>
const T* ssim_window();

// Computes `factor` · the mean unevenness of depths (unevenness.h), with photos [count, 3, H, W], over all pairs of neighbouring pixels.
// Writes the gradient with respect to the depths if `gradient` isn't null.
template <class T>
double depth_smoothness(const LossJob<T>& job, double factor, T* gradient, int num_threads);

// ---- depths of a photo's pixels by comparison with other photos ----

// Searches the planes with the inverse depths 0, step, …, (planes − 1) · step (plane_sweep.h). Writes the best inverse depth of each pixel
// and its score, both [H, W].
void search_depths(const PlaneSweep& sweep, int planes, float* inverse_depth, float* score, int num_threads);

// Searches them by semi-global matching (semi_global.h). Writes the inverse depth of each pixel and how sure it is, in [0, 1], both [H, W].
void match_semi_globally(const PlaneSweep& sweep, int planes, float* inverse_depth, float* confidence, int num_threads);

// ---- optimizer steps ----

// Updates `count` values and their moments: optim.h.
template <class T>
void adam(const AdamStep& step, const AdamState<T>& numbers, int64_t count, int num_threads);

// Updates nonempty matrices and their running means: optim.h. Each matrix is processed by one thread.
void muon(const MuonStep& step, const std::vector<MuonMatrix>& matrices, int num_threads);

}  // namespace globalsplat::raster
