#include "distributed.h"

#include <ATen/core/grad_mode.h>
#include <ATen/ops/cat.h>
#include <ATen/ops/zeros.h>
#include <torch/csrc/autograd/function_hook.h>
#include <torch/csrc/autograd/variable.h>
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

// State that the parameters' hooks change. Backward passes of one step run one after the other, each in one thread.
struct Buckets::State {
  // Notifies a state that a parameter has its gradient.
  struct Hook final : torch::autograd::PostAccumulateGradHook {
    Hook(std::shared_ptr<State> state, size_t parameter) : state(std::move(state)), parameter(parameter) {}
    void operator()(const at::Tensor&) override { state->on_gradient(parameter); }

    std::shared_ptr<State> state;
    size_t parameter;
  };
  struct Bucket {
    size_t first, end;  // range of parameters
    size_t missing;     // gradients not yet computed
  };

  Ranks ranks;
  std::vector<at::Tensor> parameters;
  std::vector<size_t> bucket_of;
  std::vector<Bucket> buckets;
  bool waiting = false;  // true while gradients are collected
  size_t sent = 0;       // number of buckets sent
  std::vector<bool> has_gradient;
  std::vector<c10::intrusive_ptr<c10d::Work>> works;
  std::exception_ptr error;

  void on_gradient(size_t parameter);
  void send(const Bucket& bucket);
};

void Buckets::State::on_gradient(size_t parameter) {
  if (!waiting || error) return;
  // An exception must not leave a hook in the middle of the backward pass.
  try {
    TORCH_CHECK(!has_gradient[parameter], "a parameter has had its gradient twice in a step");
    has_gradient[parameter] = true;
    --buckets[bucket_of[parameter]].missing;
    while (sent < buckets.size() && buckets[sent].missing == 0) send(buckets[sent]);
  } catch (...) {
    error = std::current_exception();
  }
}

void Buckets::State::send(const Bucket& bucket) {
  const at::NoGradGuard no_grad;
  std::vector<at::Tensor> pieces;
  for (size_t i = bucket.first; i < bucket.end; ++i) {
    const at::Tensor& gradient = parameters[i].grad();
    // All ranks must send the same amount of data, so missing gradients are sent as zeros.
    pieces.push_back(gradient.defined() ? gradient.reshape(-1) : at::zeros({parameters[i].numel()}, parameters[i].options()));
  }
  const at::Tensor flat = at::cat(pieces);
  pieces.clear();
  int64_t offset = 0;
  for (size_t i = bucket.first; i < bucket.end; ++i) {
    const at::Tensor& parameter = parameters[i];
    // The sum replaces the gradient that the optimizer reads.
    if (parameter.grad().defined()) parameter.mutable_grad() = flat.narrow(0, offset, parameter.numel()).view(parameter.sizes());
    offset += parameter.numel();
  }
  std::vector<at::Tensor> tensors{flat};
  works.push_back(start_one_at_a_time([&] { return ranks->allreduce(tensors); }));
  ++sent;
}

Buckets::Buckets(Ranks ranks, std::vector<at::Tensor> parameters, int64_t bytes) : state_(std::make_shared<State>()) {
  State& state = *state_;
  state.ranks = std::move(ranks);
  state.parameters = std::move(parameters);
  state.has_gradient.resize(state.parameters.size());
  int64_t size = 0;
  for (size_t i = 0; i < state.parameters.size(); ++i) {
    const at::Tensor& parameter = state.parameters[i];
    TORCH_CHECK(parameter.is_leaf() && parameter.requires_grad() && parameter.options().type_equal(state.parameters[0].options()),
                "parameters must be leaves of one type");
    if (state.buckets.empty() || size >= bytes) {
      state.buckets.push_back({i, i, 0});
      size = 0;
    }
    state.buckets.back().end = i + 1;
    state.bucket_of.push_back(state.buckets.size() - 1);
    size += int64_t(parameter.nbytes());
    torch::autograd::impl::set_post_acc_grad_hooks(parameter, std::make_unique<State::Hook>(state_, i));
  }
}

Buckets::~Buckets() {
  for (const at::Tensor& parameter : state_->parameters) torch::autograd::impl::set_post_acc_grad_hooks(parameter, nullptr);
}

void Buckets::begin() const {
  State& state = *state_;
  for (auto& bucket : state.buckets) bucket.missing = bucket.end - bucket.first;
  state.has_gradient.assign(state.parameters.size(), false);
  state.sent = 0;
  state.works.clear();
  state.error = nullptr;
  state.waiting = true;
}

size_t Buckets::finish() const {
  State& state = *state_;
  state.waiting = false;
  if (state.error) std::rethrow_exception(state.error);
  while (state.sent < state.buckets.size()) state.send(state.buckets[state.sent]);
  for (const auto& work : state.works) work->wait();
  state.works.clear();
  size_t gradients = 0;
  for (const at::Tensor& parameter : state.parameters) gradients += parameter.grad().defined();
  return gradients;
}

std::unique_ptr<Buckets> buckets(const ProcessGroup& group, rust::Slice<const size_t> parameters, int64_t bytes) {
  std::vector<at::Tensor> tensors;
  for (const size_t address : parameters) tensors.push_back(borrowed(address));
  return std::make_unique<Buckets>(group.ranks(), std::move(tensors), bytes);
}

}  // namespace globalsplat
