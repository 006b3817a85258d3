// Memory that is asked for before those are called who don't bear that the system refuses it.
#pragma once

#include <cstdint>

namespace globalsplat {

// Throws std::bad_alloc unless the system still gives `bytes`, and as much as oneDNN compiles in one call. Where it has none for the
// code of a product, oneDNN writes beyond what it has, or frees an address that it never set.
void expect_room_for_code(int64_t bytes);

}  // namespace globalsplat
