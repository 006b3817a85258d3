#include "jobs.h"

#include <algorithm>

#include "kernels.h"
#include "parallel.h"

namespace globalsplat::raster {
namespace {

constexpr int64_t kAdamTask = int64_t(1) << 14;  // values per task of Adam

}  // namespace

template <class T>
void adam(const AdamStep& step, const AdamState<T>& numbers, int64_t count, int num_threads) {
  parallel_for(num_threads, (count + kAdamTask - 1) / kAdamTask, [&](int64_t task) {
    kernels().of<T>().adam(step, numbers, task * kAdamTask, std::min((task + 1) * kAdamTask, count));
  });
}

void muon(const MuonStep& step, const std::vector<MuonMatrix>& matrices, int num_threads) {
  parallel_for(num_threads, int64_t(matrices.size()), [&](int64_t task) {
    const MuonMatrix& matrix = matrices[size_t(task)];
    kernels().muon(step, matrix, scratch(muon_scratch_size(matrix.rows, matrix.columns)));
  });
}

template void adam(const AdamStep&, const AdamState<float>&, int64_t, int);
template void adam(const AdamStep&, const AdamState<double>&, int64_t, int);

}  // namespace globalsplat::raster
