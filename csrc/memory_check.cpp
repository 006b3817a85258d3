#include "memory_check.h"

#include <sys/mman.h>

#include <new>

#include "threads.h"

namespace globalsplat {

void ensure_memory_for_code(int64_t bytes) {
  // oneDNN compiles a quarter or half of a MiB for every shape of a product, and in attention each thread has up to 16 shapes.
  const size_t wanted = size_t(bytes) + (size_t(threads()) << 22);
  void* const probe = mmap(nullptr, wanted, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  if (probe == MAP_FAILED) throw std::bad_alloc();
  munmap(probe, wanted);
}

}  // namespace globalsplat
