// Number of threads that the kernels of this library use.
#pragma once

namespace globalsplat {

// Returns the number that set_num_threads() has set, by default libtorch's number of threads.
int get_num_threads();

// Sets the number of threads; 0 restores the default.
void set_num_threads(int count);

}  // namespace globalsplat
