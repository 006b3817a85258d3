#include "ops.h"

#include <ATen/record_function.h>

#include <cstring>
#include <memory>
#include <string>
#include <utility>

namespace globalsplat {
namespace {

thread_local rust::Vec<rust::String> noted;
thread_local at::CallbackHandle callback = at::INVALID_CALLBACK_HANDLE;
thread_local bool only_outermost = false;
thread_local int within = 0;  // number of ops that have begun and not ended

// Returns true for a step of autograd's engine, which calls ops but is no op itself.
bool is_of_engine(const at::RecordFunction& function) {
  return !function.operator_name() && std::strncmp(function.name(), "globalsplat::", 13) != 0;
}

std::unique_ptr<at::ObserverContext> note(const at::RecordFunction& function) {
  if (only_outermost && (is_of_engine(function) || within++ > 0)) return nullptr;
  const auto op = function.operator_name();
  std::string name = op ? c10::toString(*op) : std::string(function.name());
  // `to(device)` calls the overload with all options and sets the device alone.
  if (name == "aten::to.dtype_layout" && function.inputs()[1].isNone()) name = "aten::to.device";
  noted.push_back(name);
  return nullptr;
}

void leave(const at::RecordFunction& function, at::ObserverContext*) {
  if (only_outermost && !is_of_engine(function)) --within;
}

}  // namespace

void start_recording_ops(bool outermost) {
  noted.clear();
  only_outermost = outermost;
  within = 0;
  const auto noting = at::RecordFunctionCallback(note, leave).needsInputs(true).scopes({at::RecordScope::FUNCTION});
  callback = at::addThreadLocalCallback(noting);
}

rust::Vec<rust::String> stop_recording_ops() {
  at::removeCallback(callback);
  return std::exchange(noted, {});
}

}  // namespace globalsplat
