#include "ops.h"

#include <ATen/record_function.h>

#include <memory>
#include <string>
#include <utility>

namespace globalsplat {
namespace {

thread_local rust::Vec<rust::String> noted;
thread_local at::CallbackHandle callback = at::INVALID_CALLBACK_HANDLE;

std::unique_ptr<at::ObserverContext> note(const at::RecordFunction& function) {
  const auto op = function.operator_name();
  std::string name = op ? c10::toString(*op) : std::string(function.name());
  // `to(device)` comes by the overload with all options, of which it gives the device alone.
  if (name == "aten::to.dtype_layout" && function.inputs()[1].isNone()) name = "aten::to.device";
  noted.push_back(name);
  return nullptr;
}

}  // namespace

void note_ops() {
  noted.clear();
  callback = at::addThreadLocalCallback(at::RecordFunctionCallback(note).needsInputs(true).scopes({at::RecordScope::FUNCTION}));
}

rust::Vec<rust::String> noted_ops() {
  at::removeCallback(callback);
  return std::exchange(noted, {});
}

}  // namespace globalsplat
