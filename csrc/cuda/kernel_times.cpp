#include "kernel_times.h"

#include <c10/core/Event.h>

#include <algorithm>
#include <atomic>
#include <mutex>
#include <vector>

#include "globalsplat-csrc/src/render.rs.h"

namespace globalsplat {
namespace {

struct Launched {
  const char* kernel;
  c10::Event begin, end;
};

// Not thread-local, because the backward pass launches from one of autograd's threads.
std::atomic<bool> measuring{false};
std::mutex guard;
std::vector<Launched> launched;

}  // namespace

void measure_kernels(bool on) {
  const std::lock_guard<std::mutex> lock(guard);
  launched.clear();
  measuring = on;
}

rust::Vec<KernelTime> kernel_times() {
  const std::lock_guard<std::mutex> lock(guard);
  rust::Vec<KernelTime> times;
  for (const Launched& one : launched) {
    one.end.synchronize();
    const auto same = [&](const KernelTime& time) { return time.kernel == one.kernel; };
    auto known = std::find_if(times.begin(), times.end(), same);
    if (known == times.end()) {
      times.push_back({one.kernel, 0});
      known = times.end() - 1;
    }
    known->milliseconds += one.begin.elapsedTime(one.end);
  }
  return times;
}

void cuda::measured_launch(const char* kernel, const c10::Stream& stream, const std::function<void()>& launch) {
  if (!measuring) return launch();
  const auto event = [&] { return c10::Event(stream.device_type(), c10::EventFlag::BACKEND_DEFAULT); };
  Launched one{kernel, event(), event()};
  one.begin.record(stream);
  launch();
  one.end.record(stream);
  const std::lock_guard<std::mutex> lock(guard);
  launched.push_back(std::move(one));
}

}  // namespace globalsplat
