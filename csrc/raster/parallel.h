// Work shared among threads: tasks 0 … count − 1 are taken one by one, so uneven ones balance.
#pragma once

#include <cstdint>
#include <functional>

namespace globalsplat::raster {

// Calls task(i) for every i on up to `threads` threads, this one included, and returns when all are done. Every task
// must write only what is its own: results then don't depend on the number of threads. Threads that can't be had are done
// without. A call made while another is running (from a task, or from a second thread) runs on the calling thread alone.
// What a task throws reaches the caller, once no task is running; those that hadn't begun are left out.
void parallel_for(int threads, int64_t count, const std::function<void(int64_t)>& task);

// `count` numbers that are this thread's until it asks again, on whole cache lines.
float* room(int64_t count);

}  // namespace globalsplat::raster
