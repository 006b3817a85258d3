// Optimizer steps, parallel over threads. Results are bit-identical for any number of threads.
#pragma once

#include <cstdint>
#include <vector>

#include "types.h"

namespace globalsplat::raster {

// Updates `count` values and their moments: adam.h.
template <class T>
void adam(const AdamStep& step, const AdamState<T>& numbers, int64_t count, int num_threads);

// Updates nonempty matrices and their running means: muon.h. Each matrix is processed by one thread.
void muon(const MuonStep& step, const std::vector<MuonMatrix>& matrices, int num_threads);

}  // namespace globalsplat::raster
