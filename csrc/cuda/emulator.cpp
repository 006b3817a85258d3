// macOS declares the functions of <ucontext.h> to programs of the X/Open standard alone.
#if defined(__APPLE__)
#define _XOPEN_SOURCE 700
#define _DARWIN_C_SOURCE
#endif

#include "emulator.h"

#include <ucontext.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <new>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

#include "device.h"

// Sanitizers must be notified when stacks are switched. ThreadSanitizer must not instrument this file, but must be told which threads
// synchronized.
#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/common_interface_defs.h>
#define GS_ASAN(call) call
#else
#define GS_ASAN(call)
#endif
#if defined(GS_UNDER_TSAN)
#include <sanitizer/tsan_interface.h>
#define GS_TSAN(call) call
#else
#define GS_TSAN(call)
#endif

namespace globalsplat::cuda::emulated {
namespace {

constexpr int kMaxThreads = 1024;           // per block
constexpr size_t kStack = 256 << 10;        // bytes
constexpr size_t kSharedMemory = 48 << 10;  // bytes per block: the minimum that GPUs have
constexpr size_t kLine = 64;                // alignment of its arrays
// ThreadSanitizer reports memory that two blocks use one after the other as shared.
#if defined(GS_UNDER_TSAN)
constexpr bool kReuse = false;
#else
constexpr bool kReuse = true;
#endif

// Stack, and the context that is needed to resume it.
struct Stack {
  ucontext_t context;
  void* bottom = nullptr;
  size_t size = 0;
  [[maybe_unused]] void* fake = nullptr;  // AddressSanitizer's
  [[maybe_unused]] void* fiber = nullptr;  // ThreadSanitizer's
};

void switch_stack(Stack& from, Stack& to) {
  GS_TSAN(__tsan_switch_to_fiber(to.fiber, __tsan_switch_to_fiber_no_sync));
  GS_ASAN(__sanitizer_start_switch_fiber(&from.fake, to.bottom, to.size));
  swapcontext(&from.context, &to.context);
  GS_ASAN(__sanitizer_finish_switch_fiber(from.fake, nullptr, nullptr));
}

// List of threads, by their index in the block. The data that stacks share consists of plain arrays: a template that a file compiled with
// sanitizers also instantiates might be linked from there.
struct Threads {
  int numbers[kMaxThreads];
  int count = 0;
  void add(int number) { numbers[count++] = number; }
};

struct Warp {
  Threads waiting;  // for the other threads
  int place = -1;   // in the source, of the barrier that they wait at
  uint64_t given[2][32];
};

struct Thread {
  Stack stack;
  std::unique_ptr<char[]> memory;
  // Number of calls so far. Consecutive calls alternate between two buffers, so that values are not overwritten before they are read.
  unsigned exchanges = 0, votes = 0;
  size_t shared_used = 0;
};

// Block that this thread of the CPU runs.
struct Block {
  std::unique_ptr<Thread> threads[kMaxThreads];  // as many as the largest block so far
  Stack scheduler;
  const Kernel* kernel = nullptr;
  void** arguments = nullptr;
  Index index{}, size{};
  int current = 0, done = 0;
  bool votes[2] = {};  // of this barrier and the next one
  Threads ready, waiting;
  Warp warps[kMaxThreads / 32];
  std::vector<std::unique_ptr<char[]>> shared;  // the last one belongs to this block
};
Block& block() {
  thread_local std::unique_ptr<Block> own;
  if (!own) own = std::make_unique<Block>();
  return *own;
}


// Fills uninitialized memory with values that differ every time and are often NaN.
void fill_with_garbage(void* memory, size_t bytes, std::mt19937_64& random) {
  for (size_t k = 0; k < bytes; k += 8) {
    uint64_t word = random();
    if (word % 2 == 0) word |= 0x7FC00000'7FC00000u;
    std::memcpy(static_cast<char*>(memory) + k, &word, std::min<size_t>(8, bytes - k));
  }
}

Thread& current() { return *block().threads[block().current]; }

// Runs one thread of the GPU after the other on this stack.
void run_threads() {
  GS_ASAN(__sanitizer_finish_switch_fiber(nullptr, const_cast<const void**>(&block().scheduler.bottom), &block().scheduler.size));
  for (;;) {
    GS_TSAN(__tsan_acquire(&block().kernel));
    block().kernel->emulate(block().arguments);
    GS_TSAN(__tsan_release(&block().arguments));
    ++block().done;
    switch_stack(current().stack, block().scheduler);
  }
}

std::unique_ptr<Thread> new_thread() {
  auto thread = std::make_unique<Thread>();
  thread->memory.reset(new char[kStack]);
  Stack& stack = thread->stack;
  stack.bottom = thread->memory.get();
  stack.size = kStack;
  getcontext(&stack.context);
  stack.context.uc_stack.ss_sp = stack.bottom;
  stack.context.uc_stack.ss_size = stack.size;
  makecontext(&stack.context, run_threads, 0);
  GS_TSAN(stack.fiber = __tsan_create_fiber(0));
  return thread;
}

// Waits until `all` threads have arrived.
void wait_at_barrier(Threads& waiting, int all) {
  GS_TSAN(__tsan_release(&waiting));
  if (waiting.count + 1 == all) {
    for (int k = 0; k < waiting.count; ++k) block().ready.add(waiting.numbers[k]);
    waiting.count = 0;
  } else {
    waiting.add(block().current);
    switch_stack(current().stack, block().scheduler);
  }
}

Warp& own_warp() { return block().warps[block().current / 32]; }

void run_block(std::mt19937_64& order) {
  const int threads = int(block().size.x);
  if (block().shared.empty() || !kReuse) block().shared.emplace_back(new char[kSharedMemory]);
  // Values that the previous block left must not be usable.
  fill_with_garbage(block().shared.back().get(), kSharedMemory, order);
  GS_TSAN(__tsan_release(&block().kernel));
  block().done = block().ready.count = block().waiting.count = 0;
  block().votes[0] = block().votes[1] = false;
  for (int k = 0; k < threads; ++k) {
    block().ready.add(k);
    block().threads[k]->shared_used = 0;
    block().threads[k]->votes = 0;
    block().warps[k / 32].waiting.count = 0;
  }
  while (block().ready.count > 0) {
    int* const ready = block().ready.numbers;
    std::swap(ready[order() % uint64_t(block().ready.count)], ready[block().ready.count - 1]);
    block().current = ready[--block().ready.count];
    switch_stack(block().scheduler, current().stack);
  }
  if (block().done < threads) {
    for (auto& thread : block().threads) thread.reset();
    throw std::logic_error(std::string(block().kernel->name) + ": threads wait for others that have ended");
  }
}

}  // namespace

Index thread_index() { return {unsigned(block().current), 0}; }
Index block_index() { return block().index; }
Index block_size() { return block().size; }

void sync_block() {
  wait_at_barrier(block().waiting, int(block().size.x));
  GS_TSAN(__tsan_acquire(&block().waiting));
}

void sync_warp() {
  Warp& warp = own_warp();
  warp.place = -1;
  wait_at_barrier(warp.waiting, 32);
  GS_TSAN(__tsan_acquire(&warp.waiting));
}

bool sync_block_or(bool given) {
  const unsigned turn = current().votes++ % 2;
  block().votes[turn] |= given;
  if (block().waiting.count + 1 == int(block().size.x)) block().votes[1 - turn] = false;  // all threads have read it
  sync_block();
  return block().votes[turn];
}

void exchange(int line, uint64_t given, uint64_t (&out)[32]) {
  Warp& warp = own_warp();
  if (warp.waiting.count > 0 && warp.place != line) {
    std::fprintf(stderr, "%s: threads of a warp meet in lines %d and %d\n", block().kernel->name, warp.place, line);
    std::abort();
  }
  warp.place = line;
  uint64_t(&place)[32] = warp.given[current().exchanges++ % 2];
  place[block().current % 32] = given;
  wait_at_barrier(warp.waiting, 32);
  for (int k = 0; k < 32; ++k) out[k] = place[k];
}

void* shared_memory(size_t bytes) {
  size_t& used = current().shared_used;
  void* const memory = block().shared.back().get() + used;
  used += (bytes + kLine - 1) / kLine * kLine;
  if (used > kSharedMemory) std::abort();
  return memory;
}

Memory Emulator::allocate(size_t bytes) const {
  if (bytes == 0) return Memory();  // as for an empty tensor
  constexpr std::align_val_t alignment{256};
  void* const memory = ::operator new(bytes, alignment);
  std::mt19937_64 random(seed_++);
  fill_with_garbage(memory, bytes, random);
  return Memory(memory, [alignment](void* p) { ::operator delete(p, alignment); });
}

void Emulator::launch(const Kernel& kernel, Blocks blocks, int threads_per_block, void** arguments) const {
  block().kernel = &kernel;
  block().arguments = arguments;
  block().size = {unsigned(threads_per_block), 1};
  if (threads_per_block > kMaxThreads || threads_per_block % 32 != 0)
    throw std::logic_error("a block of " + std::to_string(threads_per_block) + " threads");
  for (int k = 0; k < threads_per_block; ++k)
    if (!block().threads[k]) block().threads[k] = new_thread();
  GS_TSAN(block().scheduler.fiber = __tsan_get_current_fiber());

  std::mt19937_64 order(seed_++);
  std::vector<uint64_t> turns(size_t(blocks.x * blocks.y));
  for (size_t k = 0; k < turns.size(); ++k) turns[k] = k;
  std::shuffle(turns.begin(), turns.end(), order);
  for (const uint64_t turn : turns) {
    block().index = {unsigned(turn % uint64_t(blocks.x)), unsigned(turn / uint64_t(blocks.x))};
    run_block(order);
  }
  GS_TSAN(__tsan_acquire(&block().arguments));
  block().shared.clear();
}

}  // namespace globalsplat::cuda::emulated
