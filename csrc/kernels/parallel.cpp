#include "parallel.h"

#include <pthread.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <new>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

namespace globalsplat::raster {
namespace {

// Pool of threads that sleep between calls. They live as long as the process: joining at exit could wait forever for a thread that the
// operating system has already ended.
class Pool {
 public:
  // Returns false if another call is running.
  bool try_run(int num_threads, int64_t count, const std::function<void(int64_t)>& task) {
    std::unique_lock<std::mutex> lock(mutex_);
    if (task_ != nullptr) return false;
    active_ = running_ = start(num_threads - 1);
    task_ = &task;
    count_ = count;
    next_ = 0;
    ++generation_;
    lock.unlock();
    wake_.notify_all();
    drain(task, count);
    lock.lock();
    done_.wait(lock, [this] { return running_ == 0; });
    task_ = nullptr;
    if (failure_) std::rethrow_exception(std::exchange(failure_, nullptr));
    return true;
  }

 private:
  // Starts missing threads and returns how many of `wanted` there are. The system may refuse some: the work is done without them, and the
  // next call tries again.
  int start(int wanted) {
    try {
      for (; workers_ < wanted; ++workers_) std::thread([this, id = workers_] { work(id); }).detach();
    } catch (const std::system_error&) {
    } catch (const std::bad_alloc&) {
    }
    return std::min(wanted, workers_);
  }

  void drain(const std::function<void(int64_t)>& task, int64_t count) {
    try {
      for (int64_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < count;) task(i);
    } catch (...) {
      next_ = count;  // prevents further tasks from starting
      std::lock_guard<std::mutex> lock(mutex_);
      if (!failure_) failure_ = std::current_exception();
    }
  }

  void work(int id) {
    uint64_t seen = 0;
    std::unique_lock<std::mutex> lock(mutex_);
    for (;;) {
      wake_.wait(lock, [&] { return generation_ != seen; });
      seen = generation_;
      if (id >= active_) continue;
      const auto* task = task_;
      const int64_t count = count_;
      lock.unlock();
      drain(*task, count);
      lock.lock();
      if (--running_ == 0) done_.notify_one();
    }
  }

  std::mutex mutex_;
  std::condition_variable wake_, done_;
  const std::function<void(int64_t)>* task_ = nullptr;  // task of the running call
  int64_t count_ = 0;
  std::atomic<int64_t> next_{0};
  int workers_ = 0, active_ = 0, running_ = 0;
  uint64_t generation_ = 0;
  std::exception_ptr failure_;  // first exception, rethrown to the caller
};

// Never destroyed, because its threads outlive main. A child of fork() inherits none of them, so its pool is constructed again in place:
// code between fork() and exec() shouldn't allocate memory.
Pool& pool() {
  static Pool* shared = [] {
    pthread_atfork(nullptr, nullptr, [] { new (shared) Pool; });
    return new Pool;
  }();
  return *shared;
}

}  // namespace

void parallel_for(int num_threads, int64_t count, const std::function<void(int64_t)>& task) {
  if (num_threads > 1 && count > 1 && pool().try_run(num_threads, count, task)) return;
  for (int64_t i = 0; i < count; ++i) task(i);
}

float* scratch(int64_t count) {
  thread_local std::vector<float> numbers;
  numbers.resize(std::max(numbers.size(), size_t(count) + 16));
  const auto address = reinterpret_cast<uintptr_t>(numbers.data());
  return numbers.data() + (64 - address % 64) % 64 / sizeof(float);
}

}  // namespace globalsplat::raster
