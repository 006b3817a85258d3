// Measurement of the time that each of the rasterizer's kernels takes on a GPU, with events around every launch. Off unless a benchmark
// turns it on.
#pragma once

#include <c10/core/Stream.h>

#include <cstdint>
#include <functional>

#include "rust/cxx.h"

namespace globalsplat {

struct KernelTime;  // shared with Rust, see src/render.rs

// Starts or ends the measurement of all launches in this process, and discards previous results.
void measure_kernels(bool on);

// Returns the total time of every kernel launched since measurement began, in the order of first launches. Waits for the GPU.
rust::Vec<KernelTime> kernel_times();

namespace cuda {

// Calls `launch`, which launches one kernel in `stream`, and measures it if measurement is on.
void measured_launch(const char* kernel, const c10::Stream& stream, const std::function<void()>& launch);

}  // namespace cuda
}  // namespace globalsplat
