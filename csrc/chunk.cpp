#include "chunk.h"

#include <ATen/ops/empty.h>
#include <ATen/ops/from_blob.h>
#include <caffe2/serialize/inline_container.h>
#include <torch/csrc/jit/serialization/pickler.h>
#include <torch/csrc/jit/serialization/unpickler.h>

#include <algorithm>
#include <string>
#include <string_view>
#include <unordered_map>
#include <vector>

#include "globalsplat-csrc/src/chunk.rs.h"

namespace globalsplat {
namespace {

using c10::IValue;
using at::Tensor;

constexpr int64_t kCameraNumbers = 18;

std::string_view view(const rust::String& text) { return {text.data(), text.size()}; }

// Tensors that lie in the file, not in copies of it.
class Storages {
 public:
  Storages(rust::Slice<const uint8_t> file, const rust::Vec<ChunkRecord>& records) : file_(file), records_(records) {
    for (const ChunkRecord& record : records) by_key_.emplace(view(record.key), &record);
  }

  // What the pickle calls the storage `key`. The pickle says how long it is; extent() doesn't believe it.
  at::DataPtr find(const std::string& key) const {
    const auto found = by_key_.find(key);
    TORCH_CHECK(found != by_key_.end(), "the archive has no data/", key, ", which a tensor asks for");
    // Nobody writes into these tensors, nor keeps them.
    void* const data = const_cast<uint8_t*>(file_.data()) + found->second->start;
    return {data, data, [](void*) {}, at::kCPU};
  }

  // Where `tensor` lies in the file. Throws unless it is in one piece, inside its record.
  ByteRange extent(const Tensor& tensor, const std::string& what) const {
    const bool sizes_fit = std::all_of(tensor.sizes().begin(), tensor.sizes().end(),
                                       [&](int64_t size) { return size >= 0 && uint64_t(size) <= file_.size(); });
    TORCH_CHECK(sizes_fit && tensor.dim() <= 2 && tensor.storage_offset() >= 0 && tensor.is_contiguous(), what,
                " is no plain tensor");
    const uint64_t length = uint64_t(tensor.numel()) * tensor.element_size();
    if (length == 0) return {0, 0};
    // The offset is the pickle's too: nothing may be assumed of the address but that it can be compared.
    const auto base = reinterpret_cast<uintptr_t>(file_.data());
    const auto storage = reinterpret_cast<uintptr_t>(tensor.storage().data());
    const auto record = std::upper_bound(records_.begin(), records_.end(), storage - base,
                                         [](uint64_t at, const ChunkRecord& r) { return at < r.start; });
    TORCH_CHECK(storage >= base && record != records_.begin(), what, " has no data");
    const ChunkRecord& in = *(record - 1);
    const uint64_t offset = uint64_t(tensor.storage_offset());
    TORCH_CHECK(offset <= in.length && offset * tensor.element_size() <= in.length &&
                    length <= in.length - offset * tensor.element_size(),
                what, " reaches beyond its data of ", in.length, " bytes");
    return {in.start + offset * tensor.element_size(), length};
  }

  template <class T>
  rust::Vec<T> numbers(const Tensor& tensor, const std::string& what) const {
    const ByteRange range = extent(tensor, what);
    rust::Vec<T> out;
    out.reserve(size_t(tensor.numel()));
    // Archives align their records; a file that doesn't is still no reason to read across an alignment.
    Tensor aligned = at::empty(tensor.sizes(), tensor.options());
    if (range.length > 0) std::memcpy(aligned.data_ptr(), file_.data() + range.start, range.length);
    const Tensor converted = aligned.to(c10::CppTypeToScalarType<T>::value).contiguous();
    std::copy_n(converted.data_ptr<T>(), converted.numel(), std::back_inserter(out));
    return out;
  }

 private:
  rust::Slice<const uint8_t> file_;
  const rust::Vec<ChunkRecord>& records_;
  std::unordered_map<std::string_view, const ChunkRecord*> by_key_;
};

IValue unpickle(rust::Slice<const uint8_t> pickle, const Storages& storages) {
  size_t position = 0;
  const auto read = [&](char* into, size_t count) {
    count = std::min(count, pickle.size() - position);
    std::memcpy(into, pickle.data() + position, count);
    position += count;
    return count;
  };
  torch::jit::Unpickler unpickler(read, /*type_resolver=*/nullptr, /*obj_loader=*/nullptr,
                                  [&](const std::string& key) { return storages.find(key); }, /*device=*/std::nullopt);
  return unpickler.parse_ivalue();
}

// A scene's entry, with the scene and the field in every message.
class Fields {
 public:
  Fields(const IValue& scene, size_t index) : scene_("scene " + std::to_string(index)) {
    TORCH_CHECK(scene.isGenericDict(), scene_, " is a ", scene.tagKind(), ", expected a dict");
    dict_ = scene.toGenericDict();
  }

  std::string name(const char* field) const { return std::string(field) + " of " + scene_; }

  IValue at(const char* field) const {
    TORCH_CHECK(dict_.contains(field), scene_, " has no ", field);
    return dict_.at(field);
  }

  std::string string(const char* field) const {
    const IValue value = at(field);
    TORCH_CHECK(value.isString(), name(field), " is a ", value.tagKind(), ", expected a string");
    return value.toStringRef();
  }

  Tensor tensor(const char* field) const {
    const IValue value = at(field);
    TORCH_CHECK(value.isTensor(), name(field), " is a ", value.tagKind(), ", expected a tensor");
    return value.toTensor();
  }

  std::vector<Tensor> tensors(const char* field) const {
    const IValue list = at(field);
    TORCH_CHECK(list.isList(), name(field), " is a ", list.tagKind(), ", expected a list of tensors");
    std::vector<Tensor> out;
    for (const IValue& item : list.toListRef()) {
      TORCH_CHECK(item.isTensor(), name(field), " holds a ", item.tagKind(), ", expected tensors");
      out.push_back(item.toTensor());
    }
    return out;
  }

 private:
  std::string scene_;
  c10::impl::GenericDict dict_{c10::AnyType::get(), c10::AnyType::get()};
};

ChunkScene scene(const Fields& fields, const Storages& storages) {
  const Tensor cameras = fields.tensor("cameras"), timestamps = fields.tensor("timestamps");
  const std::vector<Tensor> images = fields.tensors("images");
  const auto views = int64_t(images.size());
  TORCH_CHECK(cameras.dim() == 2 && cameras.size(0) == views && cameras.size(1) == kCameraNumbers && cameras.is_floating_point(),
              fields.name("cameras"), " is ", cameras.scalar_type(), " ", cameras.sizes(), ", expected Float [", views, ", ",
              kCameraNumbers, "] for as many images");
  TORCH_CHECK(timestamps.dim() == 1 && timestamps.size(0) == views, fields.name("timestamps"), " has shape ",
              timestamps.sizes(), ", expected [", views, "] for as many images");
  ChunkScene out;
  out.key = fields.string("key");
  out.url = fields.string("url");
  out.cameras = storages.numbers<float>(cameras, fields.name("cameras"));
  out.timestamps = storages.numbers<int64_t>(timestamps, fields.name("timestamps"));
  for (const Tensor& image : images) {
    TORCH_CHECK(image.dim() == 1 && image.scalar_type() == at::kByte, "an image of ", fields.name("images"), " is ",
                image.scalar_type(), " ", image.sizes(), ", expected the bytes of a JPEG");
    out.images.push_back(storages.extent(image, fields.name("images")));
  }
  return out;
}

// `numbers` as a tensor, not copied.
template <class Numbers>
Tensor tensor(const Numbers& numbers, at::ScalarType type) {
  const auto count = int64_t(numbers.size());
  return at::from_blob(const_cast<void*>(static_cast<const void*>(numbers.data())), {count}, type);
}

}  // namespace

rust::Vec<ChunkScene> unpickle_scenes(rust::Slice<const uint8_t> file, rust::Slice<const uint8_t> pickle,
                                      const rust::Vec<ChunkRecord>& records) {
  const Storages storages(file, records);
  const IValue list = unpickle(pickle, storages);
  TORCH_CHECK(list.isList(), "the pickle holds a ", list.tagKind(), ", expected a list of scenes");
  rust::Vec<ChunkScene> scenes;
  const auto items = list.toListRef();
  for (size_t i = 0; i < items.size(); ++i) scenes.push_back(scene(Fields(items[i], i), storages));
  return scenes;
}

std::unique_ptr<std::vector<uint8_t>> pickle_scenes(const rust::Vec<SceneToPickle>& scenes) {
  const auto any = c10::AnyType::get();
  c10::impl::GenericList list(any);
  for (const SceneToPickle& scene : scenes) {
    // A list of anything: a list of tensors would be a type of its own in the pickle.
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
  // As torch::pickle_save() does it, but for the types of lists and dicts, which it adds and Python's weights_only refuses.
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
