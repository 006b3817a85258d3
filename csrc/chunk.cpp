#include "chunk.h"

#include <ATen/ops/from_blob.h>
#include <caffe2/serialize/inline_container.h>
#include <torch/csrc/jit/serialization/pickler.h>

#include <string>
#include <vector>

#include "globalsplat-csrc/src/chunk.rs.h"

namespace globalsplat {
namespace {

using at::Tensor;

constexpr int64_t kCameraNumbers = 18;

// Wraps `numbers` as a tensor without copying.
template <class Numbers>
Tensor tensor(const Numbers& numbers, at::ScalarType type) {
  const auto count = int64_t(numbers.size());
  return at::from_blob(const_cast<void*>(static_cast<const void*>(numbers.data())), {count}, type);
}

}  // namespace

std::unique_ptr<std::vector<uint8_t>> pickle_scenes(const rust::Vec<SceneToPickle>& scenes) {
  const auto any = c10::AnyType::get();
  c10::impl::GenericList list(any);
  for (const SceneToPickle& scene : scenes) {
    // A list of type Any: a list of tensors would have its own type in the pickle.
    c10::impl::GenericList images(any);
    for (const EncodedImage& image : scene.images) images.push_back(tensor(image.bytes, at::kByte));
    c10::impl::GenericDict dict(c10::StringType::get(), any);
    dict.insert("url", std::string(scene.url));
    dict.insert("timestamps", tensor(scene.timestamps, at::kLong));
    dict.insert("cameras", tensor(scene.cameras, at::kFloat).view({-1, kCameraNumbers}));
    dict.insert("images", images);
    dict.insert("key", std::string(scene.key));
    list.push_back(dict);
  }
  // Like torch::pickle_save(), but without the type tags of lists and dicts, which Python's weights_only mode refuses.
  std::vector<char> pickle;
  torch::jit::Pickler pickler([&](const char* bytes, size_t count) { pickle.insert(pickle.end(), bytes, bytes + count); },
                              nullptr, nullptr, nullptr, nullptr, /*tag_aggregates=*/false);
  pickler.protocol();
  pickler.pushIValue(list);
  pickler.stop();
  auto out = std::make_unique<std::vector<uint8_t>>();
  caffe2::serialize::PyTorchStreamWriter archive([&](const void* bytes, size_t count) {
    const auto* const first = static_cast<const uint8_t*>(bytes);
    out->insert(out->end(), first, first + count);
    return count;
  });
  archive.writeRecord("data.pkl", pickle.data(), pickle.size());
  for (size_t key = 0; key < pickler.tensorData().size(); ++key) {
    const Tensor& t = pickler.tensorData()[key];
    archive.writeRecord("data/" + std::to_string(key), t.data_ptr(), t.nbytes());
  }
  archive.writeEndOfFile();
  return out;
}

}  // namespace globalsplat
