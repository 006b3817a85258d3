// Recording of the libtorch ops that a computation calls, for tests that count them.
#pragma once

#include "rust/cxx.h"

namespace globalsplat {

// Begins recording the libtorch ops that this thread runs, backward passes included. With `outermost`, ops called by other ops
// are left out.
void start_recording_ops(bool outermost);

// Ends recording and returns the ops' full names ("aten::add.Tensor") in order. An op that moves a tensor to a device, including the device
// on which it already is, is "aten::to.device".
rust::Vec<rust::String> stop_recording_ops();

}  // namespace globalsplat
