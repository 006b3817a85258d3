// Which ops libtorch is asked for: what tests count.
#pragma once

#include "rust/cxx.h"

namespace globalsplat {

// From now on this thread notes every op that it has libtorch do, those of backward passes too; those inside of others unless
// `outermost` alone are wanted.
void note_ops(bool outermost);

// Ends that. The ops by their full names ("aten::add.Tensor"), in their order; what moves a tensor to a device, be it the one where it
// is, is "aten::to.device".
rust::Vec<rust::String> noted_ops();

}  // namespace globalsplat
