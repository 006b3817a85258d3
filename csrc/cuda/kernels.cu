// All kernels for a GPU as one source, which NVRTC compiles for the current device when it is first needed. Any C++ compiler compiles it
// against emulator.h for tests. The maths is that of kernels/, with single values instead of vectors.
#define GS_LANE
#define GS_ISA lane
#ifdef __CUDACC__
// Declares shared memory of a block; `extents` are those of an array.
#define GS_SHARED(type, name, extents) __shared__ type name extents
#endif

#include "gaussians.h"
#include "losses.h"
#include "sort.h"
#include "tile_lists.h"
#include "tiles.h"
