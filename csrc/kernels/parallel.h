// Parallel execution of tasks 0 … count − 1. Threads take them one by one, which balances tasks of different duration.
#pragma once

#include <cstdint>
#include <functional>

namespace globalsplat::raster {

// Calls task(i) for every i on up to `num_threads` threads including this one, and returns when all are done. Each task must write only its
// own data; results then don't depend on the number of threads. Works with fewer threads if the system refuses some. A call made while
// another is running (from a task, or from a second thread) runs on the calling thread alone. An exception thrown by a task reaches the
// caller once no task is running; tasks that have not begun are skipped.
void parallel_for(int num_threads, int64_t count, const std::function<void(int64_t)>& task);

// Returns scratch memory for `count` floats, aligned to cache lines. It belongs to this thread until the thread's next call.
float* scratch(int64_t count);

}  // namespace globalsplat::raster
