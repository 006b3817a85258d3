// The ops on torch tensors besides the rasterizer. Rust calls them through cxx. Tensors are passed and returned as addresses: those that are
// passed must be live, and those that are returned are new and belong to the caller. All ops throw (a Rust error) if shapes or types don't
// fit.
#pragma once

#include <cstddef>
#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

// Shared with Rust, see src/tensor_ops.rs.
struct PhotoToCompare;
struct AdamArguments;
struct AdamWOptions;
struct MuonOptions;

// Returns true if attention() supports heads of this width: with float32, or with bfloat16 if bf16 products are available. Throws if the
// memory for this test can't be allocated.
bool supports_attention(int64_t width, bool is_bf16);

// Computes softmax(q kᵀ / √(d/h)) v over h adjacent heads (kernels/attention.h). q is [B, n, d], k and v are [B, m, d] with m at least 1,
// float32 or bfloat16 on the CPU, with any strides. Returns a contiguous tensor [B, n, d] of their kind. Differentiable once.
size_t attention(size_t q, size_t k, size_t v, int64_t heads);

// Computes xs weightsᵀ + bias for xs [.., k], weights [n, k] and bias [n], float32 or bfloat16 on the CPU; `bias` is 0 if there is none.
// Returns a tensor [.., n], with the same bits for any number of threads. Differentiable once. Throws also if the system has no memory for
// the products' generated code. Float32 products use oneDNN if it is faster than libtorch's choice, MKL; bfloat16 products use libtorch's
// choice, which is oneDNN.
size_t linear(size_t xs, size_t weights, size_t bias);

// Computes `l1_weight` · mean |picture − photo| + `ssim_weight` · mean SSIM (spec 9.4) of two tensors [.., H, W] of one shape, both sides
// at least 11. Returns a scalar on the device of `picture`, float64 if `picture` is and float32 otherwise. Differentiable with respect to
// `picture`.
size_t photometric(size_t picture, size_t photo, double l1_weight, double ssim_weight);

// Computes `factor` · the edge-aware smoothness of depths (kernels/smoothness.h), for depths [.., H, W] and photos [.., 3, H, W]. Device and
// type are as in photometric(). Differentiable with respect to the depths.
size_t depth_smoothness(size_t depths, size_t photos, double factor);

// Computes the inverse depth at which each pixel of `gray` looks most alike in the other photos, and its score there
// (kernels/plane_sweep.h); or, if `semi_global`, the inverse depth by semi-global matching and how sure it is, in [0, 1]
// (kernels/semi_global.h). Candidates are the multiples 0 to `planes` − 1 of `step`. Photos are [H, W], both sides at least 9; the address
// of a weight is 0 if every pixel counts. Returns two tensors [H, W], float32 on the CPU.
rust::Vec<size_t> search_depths(size_t gray, size_t weight, rust::Slice<const PhotoToCompare> others, float step, int32_t planes,
                                bool semi_global);

// Computes the norm of all elements of all tensors, a scalar.
size_t norm(rust::Slice<const size_t> tensors);

// Multiplies tensors by `factor` in place.
void scale(rust::Slice<const size_t> tensors, double factor);

// Resets gradients to undefined, as before the first backward pass.
void zero_grad(rust::Slice<const size_t> tensors);

// Runs a step of AdamW (spec 8.5) with libtorch's fused kernel. All tensors must be contiguous, of one type and on one device.
void fused_adamw(rust::Slice<const size_t> values, rust::Slice<const size_t> gradients, rust::Slice<const size_t> first,
                 rust::Slice<const size_t> second, const AdamWOptions& of);

// Runs a step of Muon (spec 8.5) on matrices and on the running means of their gradients. All must be contiguous float32 matrices on the
// CPU, each consisting of `parts` equally high matrices stacked vertically; throws otherwise.
void muon(rust::Slice<const size_t> values, rust::Slice<const size_t> gradients, rust::Slice<const size_t> first, const MuonOptions& of);

// Runs a step of Adam: updates a tensor and its moments in place, hidden from autograd. All four tensors must be contiguous, on the CPU, of
// one shape and type, float32 or float64; throws otherwise.
void adam(const AdamArguments& of);

}  // namespace globalsplat
