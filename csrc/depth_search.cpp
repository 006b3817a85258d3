#include "depth_search.h"

#include <algorithm>
#include <vector>

#include <ATen/ops/empty.h>

#include "globalsplat-csrc/src/depth_search.rs.h"
#include "kernels/depth_search.h"
#include "threads.h"

namespace globalsplat {

void search_depths(size_t grey, size_t weight, rust::Slice<const PhotoToCompare> others, float step, int32_t planes,
                   rust::Slice<size_t> out) {
  const auto borrowed = [](size_t address) -> const at::Tensor& { return *reinterpret_cast<const at::Tensor*>(address); };
  std::vector<at::Tensor> kept;
  const auto photo_of = [&](size_t grey_address, size_t weight_address) {
    const auto data = [&](size_t address) {
      kept.push_back(borrowed(address).to(at::kCPU, at::kFloat).contiguous());
      return kept.back().const_data_ptr<float>();
    };
    const at::Tensor& values = borrowed(grey_address);
    TORCH_CHECK(values.dim() == 2 && values.size(0) >= raster::kPatch && values.size(1) >= raster::kPatch, "a photo has shape ",
                values.sizes(), ", expected [H, W] with H and W of ", raster::kPatch, " or more");
    TORCH_CHECK(weight_address == 0 || borrowed(weight_address).sizes() == values.sizes(), "the weights of a photo of shape ",
                values.sizes(), " have another shape");
    return raster::SweepPhoto{data(grey_address), weight_address == 0 ? nullptr : data(weight_address), int(values.size(1)),
                              int(values.size(0))};
  };
  TORCH_CHECK(!others.empty() && planes > 0, "there are ", others.size(), " photos to compare and ", planes, " planes, expected 1 or more");
  std::vector<raster::ComparedPhoto> compared;
  for (const PhotoToCompare& other : others) {
    compared.push_back({photo_of(other.grey, other.weight), {}});
    std::copy(other.to_pixels.begin(), other.to_pixels.end(), compared.back().to_pixels);
  }
  const raster::PlaneSweep sweep{photo_of(grey, weight), compared.data(), int(compared.size()), step};
  const at::Tensor inverse_depth = at::empty({sweep.own.height, sweep.own.width}, at::kFloat), score = at::empty_like(inverse_depth);
  raster::search_depths(sweep, planes, inverse_depth.data_ptr<float>(), score.data_ptr<float>(), get_num_threads());
  out[0] = reinterpret_cast<size_t>(new at::Tensor(inverse_depth));
  out[1] = reinterpret_cast<size_t>(new at::Tensor(score));
}

}  // namespace globalsplat
