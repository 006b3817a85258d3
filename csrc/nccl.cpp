// Ranks on GPUs. The program isn't linked to libtorch's CUDA library, which is loaded when a GPU is requested. The functions that create an
// NCCL group are therefore looked up by name, and everything else goes through c10d's virtual functions.
#include "distributed.h"

#if __has_include(<nccl.h>) && __has_include(<cuda_runtime.h>) && __has_include(<crt/host_config.h>) && __has_include(<nv/target>)
#define GLOBALSPLAT_NCCL 1
#define USE_C10D_NCCL
#include <torch/csrc/distributed/c10d/ProcessGroupNCCL.hpp>
#else
#define GLOBALSPLAT_NCCL 0
#endif

#include <dlfcn.h>

#include <chrono>
#include <new>
#include <stdexcept>
#include <string>
#include <utility>

namespace globalsplat {

bool has_nccl() { return GLOBALSPLAT_NCCL; }

#if GLOBALSPLAT_NCCL
namespace {

using c10d::ProcessGroupNCCL;
using Options = ProcessGroupNCCL::Options;

// Returns a function of libtorch's CUDA library, given its mangled name.
template <class Function>
Function* loaded(const char* name) {
  void* const function = dlsym(RTLD_DEFAULT, name);
  TORCH_CHECK(function, "this libtorch has no NCCL");
  return reinterpret_cast<Function*>(function);
}

// Creates an object with a constructor, which is a function of the object's address and of the arguments.
template <class T, class... Arguments>
c10::intrusive_ptr<T> constructed(void (*constructor)(void*, Arguments...), std::common_type_t<Arguments>... arguments) {
  void* const place = ::operator new(sizeof(T));
  try {
    constructor(place, std::move(arguments)...);
  } catch (...) {
    ::operator delete(place);
    throw;
  }
  return c10::intrusive_ptr<T>::unsafe_steal_from_new(static_cast<T*>(place));
}

}  // namespace

std::unique_ptr<ProcessGroup> new_nccl_group(const Store& store, int32_t rank, int32_t ranks, int64_t seconds) {
  // Options contain a struct of NCCL that grows from version to version.
  int version = 0;
  loaded<int(int*)>("ncclGetVersion")(&version);
  TORCH_CHECK(version == NCCL_VERSION_CODE, "built for NCCL ", NCCL_VERSION_CODE, ", libtorch has ", version);
  auto options = constructed<Options>(loaded<void(void*, bool)>("_ZN4c10d16ProcessGroupNCCL7OptionsC1Eb"), false);
  options->timeout = std::chrono::seconds(seconds);
  using Constructor = void(void*, c10::intrusive_ptr<c10d::Store>, int, int, c10::intrusive_ptr<Options>);
  auto* const constructor = loaded<Constructor>(
      "_ZN4c10d16ProcessGroupNCCLC1EN3c1013intrusive_ptrINS_5StoreENS1_6detail34intrusive_target_default_null_typeIS3_EEEEiiNS2_INS0_"
      "7OptionsENS5_IS8_EEEE");
  return std::make_unique<ProcessGroup>(constructed<ProcessGroupNCCL>(constructor, store.inner(), rank, ranks, std::move(options)));
}
#else
std::unique_ptr<ProcessGroup> new_nccl_group(const Store&, int32_t, int32_t, int64_t) { throw std::runtime_error("built without NCCL"); }
#endif

}  // namespace globalsplat
