#include "device.h"

#include <ATen/Context.h>
#include <ATen/ops/empty.h>
#include <c10/core/CachingDeviceAllocator.h>
#include <c10/core/StreamGuard.h>
#include <c10/core/impl/VirtualGuardImpl.h>

#include <utility>

namespace globalsplat {
namespace {

c10::impl::VirtualGuardImpl driver() { return c10::impl::VirtualGuardImpl(c10::kCUDA); }

c10::Device by_number(int32_t gpu) { return {c10::kCUDA, static_cast<c10::DeviceIndex>(gpu)}; }

}  // namespace

// Only events of the backend's default kind record times.
CudaEvent::CudaEvent(int32_t gpu) : event_(c10::kCUDA, c10::EventFlag::BACKEND_DEFAULT) { event_.record(driver().getStream(by_number(gpu))); }

double CudaEvent::milliseconds_since(const CudaEvent& earlier) const {
  earlier.event_.synchronize();
  event_.synchronize();
  return earlier.event_.elapsedTime(event_);
}

std::unique_ptr<CudaEvent> record_event(int32_t gpu) { return std::make_unique<CudaEvent>(gpu); }

PendingCopies::PendingCopies(std::vector<at::Tensor> tensors, c10::Event done) : tensors_(std::move(tensors)), done_(std::move(done)) {}

void PendingCopies::take_tensors(rust::Slice<size_t> out) const {
  TORCH_CHECK(out.size() == tensors_.size(), "there are ", tensors_.size(), " copies, and places for ", out.size());
  const c10::Stream current = driver().getStream(tensors_.at(0).device());
  done_.block(current);
  for (size_t k = 0; k < out.size(); ++k) {
    // If a tensor is freed, the allocator then reuses its memory for later copies only after this stream has done the work enqueued until
    // then.
    tensors_[k].record_stream(current);
    out[k] = reinterpret_cast<size_t>(new at::Tensor(tensors_[k]));
  }
}

CopyStream::CopyStream(int32_t gpu) : stream_(driver().getStreamFromGlobalPool(by_number(gpu))) {}

std::unique_ptr<PendingCopies> CopyStream::copy(rust::Slice<const size_t> tensors) const {
  const c10::StreamGuard here(stream_);
  std::vector<at::Tensor> copies;
  for (const size_t address : tensors) {
    const at::Tensor original = reinterpret_cast<const at::Tensor*>(address)->contiguous();
    const at::Tensor locked = original.is_pinned() ? original : original.pin_memory();
    copies.push_back(locked.to(stream_.device(), locked.scalar_type(), /*non_blocking=*/true));
  }
  c10::Event done(c10::kCUDA);
  done.record(stream_);
  return std::make_unique<PendingCopies>(std::move(copies), std::move(done));
}

std::unique_ptr<CopyStream> copy_stream(int32_t gpu) { return std::make_unique<CopyStream>(gpu); }

void empty_pinned_bytes(rust::Slice<const int64_t> shape, rust::Slice<size_t> out) {
  const auto options = at::TensorOptions(at::kByte).pinned_memory(true);
  out[0] = reinterpret_cast<size_t>(new at::Tensor(at::empty(at::IntArrayRef(shape.data(), shape.size()), options)));
}

uint64_t max_memory_allocated(int32_t gpu) {
  const auto stats = at::getDeviceAllocator(c10::kCUDA)->getDeviceStats(by_number(gpu).index());
  return uint64_t(stats.allocated_bytes[size_t(c10::CachingAllocator::StatType::AGGREGATE)].peak);
}

void reset_peak_memory_stats(int32_t gpu) { at::getDeviceAllocator(c10::kCUDA)->resetPeakStats(by_number(gpu).index()); }

void disable_tf32() { at::globalContext().setAllowTF32CuDNN(false); }

}  // namespace globalsplat
