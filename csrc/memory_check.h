// Checks of available memory before calls into libraries that don't handle failed allocations.
#pragma once

#include <cstdint>

namespace globalsplat {

// Throws std::bad_alloc unless the system can still allocate `bytes`, plus the memory that oneDNN's compiler needs in one call. If the
// allocation for a product's code fails, oneDNN writes out of bounds or frees an uninitialized pointer.
void ensure_memory_for_code(int64_t bytes);

}  // namespace globalsplat
