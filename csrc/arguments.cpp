#include "arguments.h"

#include "globalsplat-csrc/src/render.rs.h"

namespace globalsplat {
namespace {

constexpr int64_t kMaxSide = 1 << 20;              // pixels
constexpr int64_t kMaxCount = int64_t(1) << 31;    // Gaussians are indexed by 32 bits

void expect_shape(const char* name, const Tensor& t, std::vector<int64_t> expected) {
  TORCH_CHECK(t.sizes() == at::IntArrayRef(expected), name, " has shape ", t.sizes(), ", expected ",
              at::IntArrayRef(expected));
}

}  // namespace

void Arguments::check() const {
  TORCH_CHECK(means.dim() == 3 && w2c.dim() == 4 && sh.dim() == 4,
              "means must be [B, N, 3], sh [B, N, bases, 3] and w2c [B, C, 4, 4]");
  const int64_t scenes = means.size(0), count = means.size(1), cameras = w2c.size(1), bases = sh.size(2);
  expect_shape("means", means, {scenes, count, 3});
  expect_shape("scales", scales, {scenes, count, 3});
  expect_shape("quaternions", quaternions, {scenes, count, 4});
  expect_shape("opacities", opacities, {scenes, count});
  expect_shape("sh", sh, {scenes, count, bases, 3});
  expect_shape("w2c", w2c, {scenes, cameras, 4, 4});
  expect_shape("intrinsics", intrinsics, {scenes, cameras, 3, 3});
  TORCH_CHECK(bases == 1 || bases == 4 || bases == 9 || bases == 16, "sh has ", bases,
              " basis functions, expected 1, 4, 9 or 16");
  TORCH_CHECK(width > 0 && height > 0 && width <= kMaxSide && height <= kMaxSide, "the image is ", width, "×",
              height, ", expected sides from 1 to ", kMaxSide);
  TORCH_CHECK(count < kMaxCount, "there are ", count, " Gaussians, expected fewer than ", kMaxCount);
  TORCH_CHECK(projection.eps2d >= 0, "eps2d is ", projection.eps2d, ", expected 0 or more");
  TORCH_CHECK(projection.near_plane >= 0, "near_plane is ", projection.near_plane, ", expected 0 or more");
  TORCH_CHECK(!projection.direct_colors || bases == 1, "colors have shape ", sh.sizes(), ", expected [B, N, 1, 3]");
}

Inputs Arguments::to_inputs(at::Device device) const {
  const auto type = means.scalar_type() == at::kDouble ? at::kDouble : at::kFloat;
  const auto there = [&](const Tensor& t) { return t.to(device, type).contiguous(); };
  return {{there(means), there(scales), there(quaternions), there(opacities), there(sh)},
          there(w2c), there(intrinsics.detach()), width, height, projection};
}

Arguments borrowed(const SplatArguments& of) {
  const auto tensor = [](size_t address) -> const Tensor& { return *reinterpret_cast<const Tensor*>(address); };
  return {tensor(of.means), tensor(of.scales), tensor(of.quaternions), tensor(of.opacities), tensor(of.sh),
          tensor(of.w2c), tensor(of.intrinsics), of.width, of.height, {of.eps2d, of.antialiased}};
}

}  // namespace globalsplat
