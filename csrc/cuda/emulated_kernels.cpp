// The kernels' source compiled as C++, for emulated launches.
#include "emulator.h"

#include "kernels.cu"
