#include "runtime.h"

#include <ATen/Context.h>
#include <ATen/Parallel.h>
#include <ATen/Version.h>
#include <ATen/cpu/Utils.h>
#include <ATen/detail/CUDAHooksInterface.h>
#include <ATen/ops/empty.h>
#include <ATen/record_function.h>
#include <c10/core/Allocator.h>
#include <c10/core/CachingDeviceAllocator.h>
#include <c10/core/StreamGuard.h>
#include <c10/core/impl/VirtualGuardImpl.h>
#include <c10/util/ThreadLocalDebugInfo.h>
#include <torch/version.h>

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <string>
#include <utility>

#include "globalsplat-csrc/src/runtime.rs.h"

namespace globalsplat {
namespace {

c10::impl::VirtualGuardImpl driver() { return c10::impl::VirtualGuardImpl(c10::kCUDA); }

c10::Device by_number(int32_t gpu) { return {c10::kCUDA, static_cast<c10::DeviceIndex>(gpu)}; }

// Value of MKL_CBWR. Without it, the order of MKL's sums with AVX2 depends on where its matrices lie in memory, and so on the number of
// threads.
constexpr char kStrictAvx2[] = "AVX2,STRICT";

// Sets the variables that the libraries read when they first choose a kernel. Variables that the user has set are kept.
SimdLimit limit_libraries() {
  struct Level {
    SimdLimit limit;
    const char *ours, *libtorch, *one_dnn, *mkl;
  };
  constexpr Level levels[] = {{SimdLimit::Avx2, "avx2", "avx2", "AVX2", "AVX2"},
                              {SimdLimit::Portable, "portable", "default", "SSE41", "SSE4_2"}};
  const char* const wanted = std::getenv("GLOBALSPLAT_SIMD");
  for (const Level& level : levels) {
    if (wanted == nullptr || std::string(wanted) != level.ours) continue;
    setenv("ATEN_CPU_CAPABILITY", level.libtorch, 0);
    setenv("ONEDNN_MAX_CPU_ISA", level.one_dnn, 0);
    setenv("MKL_ENABLE_INSTRUCTIONS", level.mkl, 0);
    if (level.limit == SimdLimit::Avx2) setenv("MKL_CBWR", kStrictAvx2, 0);
    return level.limit;
  }
#if defined(__x86_64__)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx2") && !__builtin_cpu_supports("avx512f")) setenv("MKL_CBWR", kStrictAvx2, 0);
#endif
  return SimdLimit::None;
}

// Set before main(), when no library has chosen a kernel yet and there are no other threads.
const SimdLimit limit = limit_libraries();

Bf16Support detect_bf16_support() {
  if (limit != SimdLimit::None) return Bf16Support::None;
  const auto capabilities = at::cpu::get_cpu_capabilities();
  const auto has = [&](const char* name) {
    const auto found = capabilities.find(name);
    return found != capabilities.end() && found->second.isBool() && found->second.toBool();
  };
  // The operating system may refuse tile instructions that the processor has.
  if (has("amx_bf16") && at::cpu::init_amx()) return Bf16Support::Tiles;
  // The latter is that of ARM64.
  return has("avx512_bf16") || has("bf16") ? Bf16Support::Vectors : Bf16Support::None;
}

std::atomic<int> own_threads{0};

thread_local rust::Vec<RecordedOp> recorded_ops;
thread_local at::CallbackHandle callback = at::INVALID_CALLBACK_HANDLE;
thread_local int depth = 0;  // number of nested ops that are running

// Returns true if `function` is a node of autograd's graph. Nodes call ops but aren't ops. Ops of this library have no operator name,
// either, but names with the prefix globalsplat::.
bool is_autograd_node(const at::RecordFunction& function) {
  return !function.operator_name() && std::strncmp(function.name(), "globalsplat::", 13) != 0;
}

std::unique_ptr<at::ObserverContext> on_op_begin(const at::RecordFunction& function) {
  const bool is_outermost = !is_autograd_node(function) && depth++ == 0;
  const auto op = function.operator_name();
  std::string name = op ? c10::toString(*op) : std::string(function.name());
  // `to(device)` calls the overload `dtype_layout` without a dtype.
  if (name == "aten::to.dtype_layout" && function.inputs()[1].isNone()) name = "aten::to.device";
  recorded_ops.push_back({name, is_outermost});
  return nullptr;
}

void on_op_end(const at::RecordFunction& function, at::ObserverContext*) {
  if (!is_autograd_node(function)) --depth;
}

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

std::unique_ptr<CudaEvent> record_event(int32_t gpu) {
  c10::Event event(c10::kCUDA, c10::EventFlag::BACKEND_DEFAULT);  // the only kind that records times
  event.record(driver().getStream(by_number(gpu)));
  return std::unique_ptr<CudaEvent>(new CudaEvent{std::move(event)});
}

double CudaEvent::milliseconds_since(const CudaEvent& earlier) const {
  earlier.event.synchronize();
  event.synchronize();
  return earlier.event.elapsedTime(event);
}

rust::Vec<size_t> PendingCopies::take_tensors() const {
  const c10::Stream current = driver().getStream(tensors.at(0).device());
  done.block(current);
  rust::Vec<size_t> out;
  for (const at::Tensor& t : tensors) {
    // If a tensor is freed, the allocator then reuses its memory for later copies only after this stream has done the work enqueued until
    // then.
    t.record_stream(current);
    out.push_back(owned(t));
  }
  return out;
}

std::unique_ptr<CopyStream> copy_stream(int32_t gpu) {
  return std::unique_ptr<CopyStream>(new CopyStream{driver().getStreamFromGlobalPool(by_number(gpu))});
}

std::unique_ptr<PendingCopies> CopyStream::copy(rust::Slice<const size_t> tensors) const {
  const c10::StreamGuard here(stream);
  std::vector<at::Tensor> copies;
  for (const size_t address : tensors) {
    const at::Tensor original = borrowed(address).contiguous();
    const at::Tensor locked = original.is_pinned() ? original : original.pin_memory();
    copies.push_back(locked.to(stream.device(), locked.scalar_type(), /*non_blocking=*/true));
  }
  c10::Event done(c10::kCUDA);
  done.record(stream);
  return std::unique_ptr<PendingCopies>(new PendingCopies{std::move(copies), std::move(done)});
}

size_t empty_pinned_bytes(rust::Slice<const int64_t> shape) {
  const auto options = at::TensorOptions(at::kByte).pinned_memory(true);
  return owned(at::empty(at::IntArrayRef(shape.data(), shape.size()), options));
}

uint64_t max_memory_allocated(int32_t gpu) {
  const auto stats = at::getDeviceAllocator(c10::kCUDA)->getDeviceStats(by_number(gpu).index());
  return uint64_t(stats.allocated_bytes[size_t(c10::CachingAllocator::StatType::AGGREGATE)].peak);
}

void reset_peak_memory_stats(int32_t gpu) { at::getDeviceAllocator(c10::kCUDA)->resetPeakStats(by_number(gpu).index()); }

void disable_tf32() { at::globalContext().setAllowTF32CuDNN(false); }

SimdLimit simd_limit() { return limit; }

rust::String libtorch_simd_level() { return at::get_cpu_capability(); }

Bf16Support cpu_bf16_support() {
  static const Bf16Support known = detect_bf16_support();
  return known;
}

// Convolutions and matrix products have the same requirement: compute capability 8.0.
bool gpu_has_bf16() { return at::detail::getCUDAHooks().supportsBFloat16ConvolutionWithCuDNNv8(); }

void flush_denormals() { at::globalContext().setFlushDenormal(true); }

int get_num_threads() {
  const int count = own_threads;
  return count > 0 ? count : at::get_num_threads();
}

void set_num_threads(int count) { own_threads = count; }

void start_recording_ops() {
  recorded_ops.clear();
  depth = 0;
  const auto recorder = at::RecordFunctionCallback(on_op_begin, on_op_end).needsInputs(true).scopes({at::RecordScope::FUNCTION});
  callback = at::addThreadLocalCallback(recorder);
}

rust::Vec<RecordedOp> stop_recording_ops() {
  at::removeCallback(callback);
  return std::exchange(recorded_ops, {});
}

void start_counting_tensor_bytes() { counting = std::make_unique<Counting>(); }

uint64_t stop_counting_tensor_bytes() {
  const int64_t most = counting->counter->most;
  counting.reset();
  return uint64_t(most);
}

rust::String libtorch_version() { return TORCH_VERSION; }

void disable_stack_traces() {
  const auto nothing = std::make_shared<const c10::PrecomputedLazyValue<std::string>>(std::string());
  c10::SetStackTraceFetcher([nothing]() -> c10::Backtrace { return nothing; });
}

}  // namespace globalsplat
