// Number of threads of our own kernels.
#pragma once

namespace globalsplat {

// Returns the number of threads: libtorch's, unless set_threads() has set another one.
int threads();

// Sets the number of threads; 0 selects libtorch's.
void set_threads(int count);

}  // namespace globalsplat
