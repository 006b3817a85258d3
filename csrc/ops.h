// Which ops libtorch is asked for: what tests count.
#pragma once

#include "rust/cxx.h"

namespace globalsplat {

// Begins recording the libtorch ops that this thread runs, backward passes included. With `outermost`, ops called by other ops
// are left out.
void note_ops(bool outermost);

// Ends that. The ops by their full names ("aten::add.Tensor"), in their order; what moves a tensor to a device, be it the one where it
// is, is "aten::to.device".
rust::Vec<rust::String> noted_ops();

}  // namespace globalsplat
