#include "kernels.h"

#include <cstdlib>
#include <stdexcept>
#include <string>

namespace globalsplat::raster {

#if defined(__x86_64__)
namespace avx512 { extern const Kernels table; }
namespace avx2 { extern const Kernels table; }
#endif
#if defined(__aarch64__)
namespace neon { extern const Kernels table; }
#else
namespace portable { extern const Kernels table; }
#endif

namespace {

struct Candidate {
  const Kernels* table;
  bool supported;
};

const Kernels& select_kernels() {
  // Sorted by preference, best first.
  const Candidate candidates[] = {
#if defined(__x86_64__)
      {&avx512::table, __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                           __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw")},
      {&avx2::table, __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")},
#endif
#if defined(__aarch64__)
      {&neon::table, true},
#else
      {&portable::table, true},
#endif
  };
  const char* forced = std::getenv("GLOBALSPLAT_SIMD");
  std::string known;
  for (const Candidate& c : candidates) {
    if (!c.supported) continue;
    if (forced == nullptr || std::string(forced) == c.table->name) return *c.table;
    known += (known.empty() ? "" : ", ") + std::string(c.table->name);
  }
  throw std::invalid_argument("GLOBALSPLAT_SIMD is '" + std::string(forced) + "', expected one of " + known);
}

}  // namespace

const Kernels& kernels() {
  static const Kernels& chosen = select_kernels();
  return chosen;
}

}  // namespace globalsplat::raster
