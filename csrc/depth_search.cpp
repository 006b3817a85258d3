#include "tensor_ops.h"

#include <algorithm>
#include <vector>

#include <ATen/ops/empty.h>

#include "globalsplat-csrc/src/tensor_ops.rs.h"
#include "kernels/jobs.h"
#include "runtime.h"

namespace globalsplat {

namespace {

// Photos of a plane sweep. The tensors keep the memory that `sweep` points to.
struct SweepTensors {
  std::vector<at::Tensor> kept;
  std::vector<raster::ComparedPhoto> compared;
  raster::PlaneSweep sweep;

  SweepTensors(size_t gray, size_t weight, rust::Slice<const PhotoToCompare> others, float step, int32_t planes, float least_variance,
               float least_correlation) {
    TORCH_CHECK(!others.empty() && planes > 0, "there are ", others.size(), " photos to compare and ", planes,
                " planes, expected 1 or more");
    for (const PhotoToCompare& other : others) {
      compared.push_back({photo_of(other.gray, other.weight), {}});
      std::copy(other.to_pixels.begin(), other.to_pixels.end(), compared.back().to_pixels);
    }
    sweep = {photo_of(gray, weight), compared.data(), int(compared.size()), step, least_variance, least_correlation};
  }

 private:
  const float* data(size_t address) {
    kept.push_back(borrowed(address).to(at::kCPU, at::kFloat).contiguous());
    return kept.back().const_data_ptr<float>();
  }

  raster::SweepPhoto photo_of(size_t gray_address, size_t weight_address) {
    const at::Tensor& values = borrowed(gray_address);
    TORCH_CHECK(values.dim() == 2 && values.size(0) >= raster::kPatch && values.size(1) >= raster::kPatch, "a photo has shape ",
                values.sizes(), ", expected [H, W] with H and W of ", raster::kPatch, " or more");
    TORCH_CHECK(weight_address == 0 || borrowed(weight_address).sizes() == values.sizes(), "the weights of a photo of shape ",
                values.sizes(), " have another shape");
    return {data(gray_address), weight_address == 0 ? nullptr : data(weight_address), int(values.size(1)), int(values.size(0))};
  }
};

}  // namespace

rust::Vec<size_t> search_depths(size_t gray, size_t weight, rust::Slice<const PhotoToCompare> others, float step, int32_t planes,
                                bool semi_global) {
  // In semi-global matching, a smooth depth needs less texture, and photos that don't show a pixel say nothing about its depth, like those
  // without any likeness.
  const SweepTensors tensors(gray, weight, others, step, planes, semi_global ? 1e-5f : 1e-4f, semi_global ? 0 : -1);
  const raster::PlaneSweep& sweep = tensors.sweep;
  const at::Tensor inverse_depth = at::empty({sweep.own.height, sweep.own.width}, at::kFloat), score = at::empty_like(inverse_depth);
  const auto search = semi_global ? raster::match_semi_globally : raster::search_depths;
  search(sweep, planes, inverse_depth.data_ptr<float>(), score.data_ptr<float>(), get_num_threads());
  rust::Vec<size_t> out;
  for (const at::Tensor& t : {inverse_depth, score}) out.push_back(owned(t));
  return out;
}

}  // namespace globalsplat
