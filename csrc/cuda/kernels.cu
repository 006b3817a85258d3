// The splat op on a GPU: one text, which NVRTC compiles for the device at hand when it is first needed, and which any C++ compiler
// compiles against emulator.h, where it is proven. The maths are raster/'s own, with one number in the place of a vector.
#define GS_LANE
#define GS_ISA lane
#ifdef __CUDACC__
// Memory that the threads of a block share; `extents` are an array's.
#define GS_SHARED(type, name, extents) __shared__ type name extents
#endif

#include "gaussians.h"
#include "lists.h"
#include "losses.h"
#include "sort.h"
#include "tiles.h"
