// Everything that knows torch, as one translation unit: reading torch's headers is half of the work.
#include "arguments.cpp"
#include "chunk.cpp"
#include "cpu/projection.cpp"
#include "cpu/splat.cpp"
#include "cuda/splat.cpp"
#include "fit.cpp"
#include "splat.cpp"
#include "threads.cpp"
