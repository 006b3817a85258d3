#include "ops.h"

#include <ATen/record_function.h>

#include <cstring>
#include <memory>
#include <string>
#include <utility>

namespace globalsplat {
namespace {

thread_local rust::Vec<rust::String> op_names;
thread_local at::CallbackHandle callback = at::INVALID_CALLBACK_HANDLE;
thread_local bool only_outermost = false;
thread_local int depth = 0;  // number of nested ops that are running

// Returns true if `function` is a node of autograd's graph. Nodes call ops but aren't ops. Ops of this library have no operator name,
// either, but names with the prefix globalsplat::.
bool is_autograd_node(const at::RecordFunction& function) {
  return !function.operator_name() && std::strncmp(function.name(), "globalsplat::", 13) != 0;
}

std::unique_ptr<at::ObserverContext> on_op_begin(const at::RecordFunction& function) {
  if (only_outermost && (is_autograd_node(function) || depth++ > 0)) return nullptr;
  const auto op = function.operator_name();
  std::string name = op ? c10::toString(*op) : std::string(function.name());
  // `to(device)` calls the overload `dtype_layout` without a dtype.
  if (name == "aten::to.dtype_layout" && function.inputs()[1].isNone()) name = "aten::to.device";
  op_names.push_back(name);
  return nullptr;
}

void on_op_end(const at::RecordFunction& function, at::ObserverContext*) {
  if (only_outermost && !is_autograd_node(function)) --depth;
}

}  // namespace

void start_recording_ops(bool outermost) {
  op_names.clear();
  only_outermost = outermost;
  depth = 0;
  const auto recorder = at::RecordFunctionCallback(on_op_begin, on_op_end).needsInputs(true).scopes({at::RecordScope::FUNCTION});
  callback = at::addThreadLocalCallback(recorder);
}

rust::Vec<rust::String> stop_recording_ops() {
  at::removeCallback(callback);
  return std::exchange(op_names, {});
}

}  // namespace globalsplat
