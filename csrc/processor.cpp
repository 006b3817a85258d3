#include "processor.h"

#include <ATen/Context.h>
#include <ATen/cpu/Utils.h>
#include <ATen/Version.h>
#include <ATen/detail/CUDAHooksInterface.h>

#include <cstdlib>
#include <string>

#include "globalsplat-csrc/src/processor.rs.h"

namespace globalsplat {

namespace {

// Sets the variables that the libraries read when they first choose a kernel. Variables that the user has set are kept.
SimdLimit limit_libraries() {
  struct Level {
    SimdLimit limit;
    const char *ours, *libtorch, *one_dnn, *mkl;
  };
  constexpr Level levels[] = {{SimdLimit::Avx2, "avx2", "avx2", "AVX2", "AVX2"},
                              {SimdLimit::Portable, "portable", "default", "SSE41", "SSE4_2"}};
  const char* const wanted = std::getenv("GLOBALSPLAT_SIMD");
  for (const Level& level : levels) {
    if (wanted == nullptr || std::string(wanted) != level.ours) continue;
    setenv("ATEN_CPU_CAPABILITY", level.libtorch, 0);
    setenv("ONEDNN_MAX_CPU_ISA", level.one_dnn, 0);
    setenv("MKL_ENABLE_INSTRUCTIONS", level.mkl, 0);
    return level.limit;
  }
  return SimdLimit::None;
}

// Set before main(), when no library has chosen a kernel yet and there are no other threads.
const SimdLimit limit = limit_libraries();

Bf16Support detect_bf16_support() {
  if (limit != SimdLimit::None) return Bf16Support::None;
  const auto capabilities = at::cpu::get_cpu_capabilities();
  const auto has = [&](const char* name) {
    const auto found = capabilities.find(name);
    return found != capabilities.end() && found->second.isBool() && found->second.toBool();
  };
  // The operating system may refuse tile instructions that the processor has.
  if (has("amx_bf16") && at::cpu::init_amx()) return Bf16Support::Tiles;
  return has("avx512_bf16") ? Bf16Support::Vectors : Bf16Support::None;
}

}  // namespace

SimdLimit simd_limit() { return limit; }

rust::String libtorch_simd_level() { return at::get_cpu_capability(); }

Bf16Support cpu_bf16_support() {
  static const Bf16Support known = detect_bf16_support();
  return known;
}

// Convolutions and matrix products have the same requirement: compute capability 8.0.
bool gpu_has_bf16() { return at::detail::getCUDAHooks().supportsBFloat16ConvolutionWithCuDNNv8(); }

void flush_denormals() { at::globalContext().setFlushDenormal(true); }

}  // namespace globalsplat
