#include "distributed.h"

#include <ATen/core/grad_mode.h>
#include <torch/csrc/distributed/c10d/Backend.hpp>
#include <torch/csrc/distributed/c10d/PrefixStore.hpp>
#include <torch/csrc/distributed/c10d/Store.hpp>
#include <torch/csrc/distributed/c10d/TCPStore.hpp>
#include <torch/csrc/distributed/c10d/Types.hpp>

#include <chrono>
#include <cstdlib>
#include <mutex>
#include <new>
#include <stdexcept>
#include <string>
#include <utility>

#include "runtime.h"

#if __has_include(<gloo/rendezvous/store.h>)
#define GLOBALSPLAT_GLOO 1
#define USE_C10D_GLOO
#include <torch/csrc/distributed/c10d/ProcessGroupGloo.hpp>
#else
#define GLOBALSPLAT_GLOO 0
#endif

#if __has_include(<nccl.h>) && __has_include(<cuda_runtime.h>) && __has_include(<crt/host_config.h>) && __has_include(<nv/target>)
#define GLOBALSPLAT_NCCL 1
#define USE_C10D_NCCL
#include <torch/csrc/distributed/c10d/ProcessGroupNCCL.hpp>
#else
#define GLOBALSPLAT_NCCL 0
#endif

#include <dlfcn.h>

namespace globalsplat {
namespace {

std::string string(rust::Str s) { return {s.data(), s.size()}; }

// Starts a collective under a process-wide mutex: c10d's flight recorder, shared by all groups of a process, updates its table of groups
// without a lock.
template <class Start>
c10::intrusive_ptr<c10d::Work> start_one_at_a_time(const Start& start) {
  static std::mutex one_at_a_time;
  const std::lock_guard<std::mutex> lock(one_at_a_time);
  return start();
}

}  // namespace

Store::Store(c10::intrusive_ptr<c10d::Store> store) : store_(std::move(store)) {}
Store::~Store() = default;

int64_t Store::add(rust::Str key, int64_t amount) const { return store_->add(string(key), amount); }

std::unique_ptr<Store> connect(rust::Str host, uint16_t port, bool is_server, rust::Str prefix, int64_t seconds) {
  c10d::TCPStoreOptions options;
  options.port = port;
  options.isServer = is_server;
  options.waitWorkers = false;
  options.timeout = std::chrono::seconds(seconds);
  auto store = c10::make_intrusive<c10d::TCPStore>(string(host), options);
  return std::make_unique<Store>(c10::make_intrusive<c10d::PrefixStore>(string(prefix), std::move(store)));
}

bool has_gloo() { return GLOBALSPLAT_GLOO; }
bool has_nccl() { return GLOBALSPLAT_NCCL; }

namespace {

#if GLOBALSPLAT_GLOO
Ranks new_gloo_group(const Store& store, int32_t rank, int32_t ranks, int64_t seconds) {
  using c10d::ProcessGroupGloo;
  auto options = ProcessGroupGloo::Options::create(std::chrono::seconds(seconds));
  // Selects the network interface like PyTorch: the one that the user names, or the one of this machine's host name.
  const char* const interface = std::getenv("GLOO_SOCKET_IFNAME");
  const bool named = interface && *interface;
  options->devices.push_back(named ? ProcessGroupGloo::createDeviceForInterface(interface) : ProcessGroupGloo::createDefaultDevice());
  auto inner = c10::make_intrusive<c10d::PrefixStore>("gloo", store.inner());
  return c10::make_intrusive<ProcessGroupGloo>(std::move(inner), rank, ranks, std::move(options));
}
#else
Ranks new_gloo_group(const Store&, int32_t, int32_t, int64_t) { throw std::runtime_error("built without Gloo"); }
#endif

// The program isn't linked to libtorch's CUDA library, which is loaded when a GPU is requested. The functions that create an NCCL group are
// therefore looked up by name, and everything else goes through c10d's virtual functions.
#if GLOBALSPLAT_NCCL
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

Ranks new_nccl_group(const Store& store, int32_t rank, int32_t ranks, int64_t seconds) {
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
  return constructed<ProcessGroupNCCL>(constructor, store.inner(), rank, ranks, std::move(options));
}
#else
Ranks new_nccl_group(const Store&, int32_t, int32_t, int64_t) { throw std::runtime_error("built without NCCL"); }
#endif

}  // namespace

std::unique_ptr<ProcessGroup> new_group(bool is_on_gpus, const Store& store, int32_t rank, int32_t ranks, int64_t seconds) {
  return std::make_unique<ProcessGroup>((is_on_gpus ? new_nccl_group : new_gloo_group)(store, rank, ranks, seconds));
}

ProcessGroup::ProcessGroup(Ranks ranks) : ranks_(std::move(ranks)) {}
ProcessGroup::~ProcessGroup() = default;

void ProcessGroup::shutdown() const { ranks_->shutdown(); }

void ProcessGroup::all_reduce(size_t tensor) const {
  const at::NoGradGuard no_grad;
  std::vector<at::Tensor> tensors{borrowed(tensor)};
  start_one_at_a_time([&] { return ranks_->allreduce(tensors); })->wait();
}

void ProcessGroup::broadcast(size_t tensor) const {
  const at::NoGradGuard no_grad;
  std::vector<at::Tensor> tensors{borrowed(tensor).detach()};
  start_one_at_a_time([&] { return ranks_->broadcast(tensors); })->wait();
}

}  // namespace globalsplat
