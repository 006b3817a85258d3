// The kernels' source compiled as C++, and their lookup by name for emulated launches.
#include "emulator.h"

#include "kernels.cu"

#include "device.h"

namespace globalsplat::cuda::emulated {
namespace {

template <auto kernel>
struct Entry;
template <class... Parameters, void (*kernel)(Parameters...)>
struct Entry<kernel> {
  template <size_t... index>
  static void call(void** arguments, std::index_sequence<index...>) {
    kernel(*static_cast<Parameters*>(arguments[index])...);
  }
  static void run(void** arguments) { call(arguments, std::index_sequence_for<Parameters...>()); }
};

#define GS_KERNEL(name) {#name, Entry<name>::run}
constexpr Kernel kKernels[] = {
    GS_KERNEL(gs_lenses),         GS_KERNEL(gs_project),          GS_KERNEL(gs_cover),
    GS_KERNEL(gs_scan),           GS_KERNEL(gs_sort_lists),       GS_KERNEL(gs_blend),
    GS_KERNEL(gs_blend_backward), GS_KERNEL(gs_project_backward), GS_KERNEL(gs_sum_cameras),
    GS_KERNEL(gs_ssim),           GS_KERNEL(gs_fit_gradient),     GS_KERNEL(gs_unevenness),
};

}  // namespace

const Kernel* kernel_named(const char* name) {
  for (const Kernel& kernel : kKernels)
    if (std::strcmp(kernel.name, name) == 0) return &kernel;
  return nullptr;
}

}  // namespace globalsplat::cuda::emulated
