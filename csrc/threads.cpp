#include "threads.h"

#include <ATen/Parallel.h>

#include <atomic>

namespace globalsplat {
namespace {

std::atomic<int> own{0};

}  // namespace

int get_num_threads() {
  const int count = own;
  return count > 0 ? count : at::get_num_threads();
}

void set_num_threads(int count) { own = count; }

}  // namespace globalsplat
