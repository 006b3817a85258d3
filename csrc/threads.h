// Among how many threads our own kernels share their work.
#pragma once

namespace globalsplat {

// As many as libtorch uses, unless set_threads() has said otherwise.
int threads();

// From now on; 0: as many as libtorch uses.
void set_threads(int count);

}  // namespace globalsplat
