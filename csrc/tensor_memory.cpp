#include "tensor_memory.h"

#include <c10/core/Allocator.h>
#include <c10/util/ThreadLocalDebugInfo.h>

#include <algorithm>
#include <memory>

namespace globalsplat {
namespace {

struct Counter final : c10::MemoryReportingInfoBase {
  void reportMemoryUsage(void*, int64_t bytes, size_t, size_t, c10::Device device) override {
    if (!device.is_cpu()) return;
    now += bytes;
    most = std::max(most, now);
  }
  bool memoryProfilingEnabled() const override { return true; }

  int64_t now = 0, most = 0;
};

struct Counting {
  std::shared_ptr<Counter> counter = std::make_shared<Counter>();
  c10::DebugInfoGuard guard{c10::DebugInfoKind::PROFILER_STATE, counter};
};

thread_local std::unique_ptr<Counting> counting;

}  // namespace

void start_counting_tensor_bytes() { counting = std::make_unique<Counting>(); }

uint64_t stop_counting_tensor_bytes() {
  const int64_t most = counting->counter->most;
  counting.reset();
  return uint64_t(most);
}

}  // namespace globalsplat
