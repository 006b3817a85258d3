// Simulated failures of allocations and of the creation of threads.
#pragma once

#include <cstdint>

namespace globalsplat::checks {

// Makes the n-th call of `operator new` from now on fail, counted from 0 over all threads, or that and all later ones.
void fail_allocations(int64_t n, bool all_after);
// Ends the failures and returns the number of calls that failed.
int64_t stop_failing_allocations();
// Returns the number of blocks of `operator new` that are not freed.
int64_t count_live_blocks();

void fail_thread_creation();
void allow_thread_creation();

}  // namespace globalsplat::checks
