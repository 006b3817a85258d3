#include "tensor_ops.h"

#include <ATen/Dispatch.h>
#include <ATen/ops/_foreach_mul.h>
#include <ATen/ops/_foreach_norm.h>
#include <ATen/ops/_fused_adamw.h>
#include <ATen/ops/full.h>
#include <ATen/ops/linalg_vector_norm.h>
#include <ATen/ops/stack.h>

#include <array>
#include <vector>

#include "globalsplat-csrc/src/tensor_ops.rs.h"
#include "kernels/jobs.h"
#include "runtime.h"

namespace globalsplat {
namespace {

using at::Tensor;

std::vector<Tensor> all_borrowed(rust::Slice<const size_t> addresses) {
  std::vector<Tensor> tensors;
  for (const size_t address : addresses) tensors.push_back(borrowed(address));
  return tensors;
}

}  // namespace

size_t norm(rust::Slice<const size_t> tensors) {
  const at::NoGradGuard no_grad;
  return owned(at::linalg_vector_norm(at::stack(at::_foreach_norm(all_borrowed(tensors)))));
}

void scale(rust::Slice<const size_t> tensors, double factor) {
  const at::NoGradGuard no_grad;
  at::_foreach_mul_(all_borrowed(tensors), factor);
}

void zero_grad(rust::Slice<const size_t> tensors) {
  for (const Tensor& t : all_borrowed(tensors)) t.mutable_grad().reset();
}

void fused_adamw(rust::Slice<const size_t> values, rust::Slice<const size_t> gradients, rust::Slice<const size_t> first,
                 rust::Slice<const size_t> second, const AdamWOptions& of) {
  if (values.empty()) return;
  const auto x = all_borrowed(values), g = all_borrowed(gradients), m = all_borrowed(first), v = all_borrowed(second);
  // The kernel assumes equal memory layouts and checks nothing but the type.
  for (const auto* list : {&x, &g, &m, &v}) {
    TORCH_CHECK(list->size() == x.size(), "every parameter must have a gradient and two moments");
    for (size_t k = 0; k < x.size(); ++k) {
      const Tensor& t = (*list)[k];
      TORCH_CHECK(t.sizes() == x[k].sizes() && t.is_contiguous() && t.device() == x[0].device() &&
                      t.scalar_type() == x[0].scalar_type(),
                  "parameters, their gradients and their moments must have equal shapes, be contiguous, and have one type and one device");
    }
  }
  const at::NoGradGuard no_grad;
  // All tensors have had the same number of steps. The scalar is created on the device, because copying it there would wait.
  const Tensor steps = at::full({}, double(of.steps), x[0].options().dtype(at::kFloat));
  at::_fused_adamw_(x, g, m, v, {}, std::vector<Tensor>(x.size(), steps), of.learning_rate, of.beta1, of.beta2, of.weight_decay,
                    of.epsilon, /*amsgrad=*/false, /*maximize=*/false);
}

void muon(rust::Slice<const size_t> values, rust::Slice<const size_t> gradients, rust::Slice<const size_t> first, const MuonOptions& of) {
  const auto x = all_borrowed(values), g = all_borrowed(gradients), m = all_borrowed(first);
  TORCH_CHECK(g.size() == x.size() && m.size() == x.size(), "every matrix must have a gradient and a running mean of it");
  std::vector<raster::MuonMatrix> matrices;
  for (size_t k = 0; k < x.size(); ++k) {
    for (const Tensor* t : {&x[k], &g[k], &m[k]})
      TORCH_CHECK(t->device().is_cpu() && t->is_contiguous() && t->scalar_type() == at::kFloat && t->sizes() == x[k].sizes(),
                  "a matrix, its gradient and the running mean of it must have one shape, be float32, contiguous, and on the CPU");
    TORCH_CHECK(x[k].dim() == 2 && x[k].numel() > 0 && of.parts > 0 && x[k].size(0) % of.parts == 0, "a matrix has shape ", x[k].sizes(),
                ", expected two sizes, the first a multiple of ", of.parts);
    const int64_t rows = x[k].size(0) / of.parts, columns = x[k].size(1);
    for (int64_t part = 0; part < of.parts; ++part) {
      const int64_t begin = part * rows * columns;
      matrices.push_back({x[k].data_ptr<float>() + begin, g[k].const_data_ptr<float>() + begin, m[k].data_ptr<float>() + begin, rows, columns});
    }
  }
  raster::muon({of.learning_rate, of.learning_rate * of.weight_decay, of.beta}, matrices, get_num_threads());
}

void adam(const AdamArguments& of) {
  const std::array<Tensor, 4> tensors = {borrowed(of.value), borrowed(of.gradient), borrowed(of.first), borrowed(of.second)};
  const Tensor& value = tensors[0];
  for (const Tensor& t : tensors)
    TORCH_CHECK(t.device().is_cpu() && t.is_contiguous() && t.sizes() == value.sizes() && t.scalar_type() == value.scalar_type() &&
                    (t.scalar_type() == at::kFloat || t.scalar_type() == at::kDouble),
                "a parameter, its gradient and its moments must have one shape and type, be contiguous, and be on the CPU");
  AT_DISPATCH_FLOATING_TYPES(value.scalar_type(), "adam", [&] {
    const raster::AdamState<scalar_t> state{value.data_ptr<scalar_t>(), tensors[1].data_ptr<scalar_t>(),
                                            tensors[2].data_ptr<scalar_t>(), tensors[3].data_ptr<scalar_t>()};
    raster::adam<scalar_t>({of.step_size, of.bias_correction2_sqrt, of.decay, of.beta1, of.beta2, of.epsilon}, state, value.numel(),
                           get_num_threads());
  });
}

}  // namespace globalsplat
