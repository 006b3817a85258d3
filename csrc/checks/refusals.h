// Simulated failures of allocations and of the creation of threads.
#pragma once

#include <cstdint>

namespace globalsplat::checks {

// Makes the n-th call of `operator new` from now on fail, counted from 0 over all threads, or that and all later ones.
void refuse_memory(int64_t n, bool all_after);
// Ends the failures and returns the number of calls that failed.
int64_t allow_memory();
// Returns the number of blocks of `operator new` that are not freed.
int64_t blocks();

void refuse_threads();
void allow_threads();

}  // namespace globalsplat::checks
