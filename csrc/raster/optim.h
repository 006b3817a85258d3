// Steps of optimizers, shared among threads. The bits don't depend on their number.
#pragma once

#include <cstdint>
#include <vector>

#include "types.h"

namespace globalsplat::raster {

// Updates `count` numbers and their moments: adam.h.
template <class T>
void adam(const AdamStep& step, const AdamNumbers<T>& numbers, int64_t count, int threads);

// Updates matrices that aren't empty, and their running means: muon.h. Each is one thread's.
void muon(const MuonStep& step, const std::vector<MuonMatrix>& matrices, int threads);

}  // namespace globalsplat::raster
