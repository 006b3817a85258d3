#include "processor.h"

#include <ATen/Context.h>
#include <ATen/cpu/Utils.h>
#include <ATen/detail/CUDAHooksInterface.h>

#include "globalsplat-csrc/src/processor.rs.h"

namespace globalsplat {

namespace {

Bf16 found() {
  const auto capabilities = at::cpu::get_cpu_capabilities();
  const auto has = [&](const char* name) {
    const auto found = capabilities.find(name);
    return found != capabilities.end() && found->second.isBool() && found->second.toBool();
  };
  // What the processor has is of no use where the system doesn't lend it.
  if (has("amx_bf16") && at::cpu::init_amx()) return Bf16::Tiles;
  return has("avx512_bf16") ? Bf16::Vectors : Bf16::None;
}

}  // namespace

Bf16 bf16_of_cpu() {
  static const Bf16 known = found();
  return known;
}

// Convolutions and matrix products need the same: compute capability 8.0.
bool gpu_has_bf16() { return at::detail::getCUDAHooks().supportsBFloat16ConvolutionWithCuDNNv8(); }

void flush_denormals() { at::globalContext().setFlushDenormal(true); }

}  // namespace globalsplat
