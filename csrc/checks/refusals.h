// What a machine may refuse: memory and threads.
#pragma once

#include <cstdint>

namespace globalsplat::checks {

// From now on `operator new` refuses its n-th call, counted from 0, or that and all after it. Any thread's calls count.
void refuse_memory(int64_t n, bool all_after);
// Gives memory again, and tells how many calls were refused.
int64_t allow_memory();
// Blocks that `operator new` gave and nobody has given back.
int64_t blocks();

void refuse_threads();
void allow_threads();

}  // namespace globalsplat::checks
