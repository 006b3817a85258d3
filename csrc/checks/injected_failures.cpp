#include "injected_failures.h"

#include <pthread.h>

#include <atomic>
#include <cstdlib>
#include <limits>
#include <new>

namespace globalsplat::checks {
namespace {

constexpr int64_t kNever = std::numeric_limits<int64_t>::max();
std::atomic<int64_t> calls_left{kNever};  // before the first one that fails
std::atomic<int64_t> refused{0}, given{0};
std::atomic<bool> refuses_all_after{false};

// Uses malloc(), so that sanitizers track the blocks.
void* allocate(size_t size, size_t alignment) {
  if (calls_left.load() != kNever) {
    const int64_t left = calls_left.fetch_sub(1);
    if (left == 0 || (left < 0 && refuses_all_after)) {
      ++refused;
      throw std::bad_alloc();
    }
  }
  void* block = alignment <= __STDCPP_DEFAULT_NEW_ALIGNMENT__
                    ? std::malloc(size == 0 ? 1 : size)
                    : std::aligned_alloc(alignment, (size + alignment - 1) / alignment * alignment);
  if (block == nullptr) throw std::bad_alloc();
  ++given;
  return block;
}

void give_back(void* block) {
  given -= block != nullptr;
  std::free(block);
}

void set_stack_size(size_t bytes) {
  pthread_attr_t attributes;
  pthread_attr_init(&attributes);
  pthread_attr_setstacksize(&attributes, bytes);
  pthread_setattr_default_np(&attributes);
  pthread_attr_destroy(&attributes);
}

}  // namespace

void fail_allocations(int64_t n, bool all_after) {
  refused = 0;
  refuses_all_after = all_after;
  calls_left = n;
}

int64_t stop_failing_allocations() {
  calls_left = kNever;
  return refused;
}

int64_t count_live_blocks() { return given; }

// No address space can hold such a stack.
void fail_thread_creation() { set_stack_size(size_t(1) << 60); }
void allow_thread_creation() { set_stack_size(size_t(8) << 20); }

}  // namespace globalsplat::checks

using globalsplat::checks::allocate;
using globalsplat::checks::give_back;
constexpr size_t kUsual = __STDCPP_DEFAULT_NEW_ALIGNMENT__;

// All forms that throw: a sanitizer's library has its own implementations, which don't call each other.
void* operator new(size_t n) { return allocate(n, kUsual); }
void* operator new[](size_t n) { return allocate(n, kUsual); }
void* operator new(size_t n, std::align_val_t a) { return allocate(n, size_t(a)); }
void* operator new[](size_t n, std::align_val_t a) { return allocate(n, size_t(a)); }
void operator delete(void* p) noexcept { give_back(p); }
void operator delete[](void* p) noexcept { give_back(p); }
void operator delete(void* p, size_t) noexcept { give_back(p); }
void operator delete[](void* p, size_t) noexcept { give_back(p); }
void operator delete(void* p, std::align_val_t) noexcept { give_back(p); }
void operator delete[](void* p, std::align_val_t) noexcept { give_back(p); }
void operator delete(void* p, size_t, std::align_val_t) noexcept { give_back(p); }
void operator delete[](void* p, size_t, std::align_val_t) noexcept { give_back(p); }
