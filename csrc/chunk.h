// RealEstate10K-style chunks: a torch.save file with a list of scenes, read and written by libtorch's own pickler. Unpickling
// in libtorch runs no code: it knows tensors, lists, dicts, strings and numbers, and refuses everything else.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "rust/cxx.h"

namespace globalsplat {

// Shared with Rust, see src/chunk.rs.
struct ChunkRecord;
struct ChunkScene;
struct SceneToPickle;

// The scenes of a chunk, whose images stay where they are in `file`, the bytes of an uncompressed torch.save archive.
// `pickle` is its data.pkl, which the reader of chunks has to have checked; `records` are its tensors' bytes in the order of
// `start`. Throws (a Rust error) on a pickle that isn't such a list.
rust::Vec<ChunkScene> unpickle_scenes(rust::Slice<const uint8_t> file, rust::Slice<const uint8_t> pickle,
                                      const rust::Vec<ChunkRecord>& records);

// The bytes of a torch.save file that holds `scenes`.
std::unique_ptr<std::vector<uint8_t>> pickle_scenes(const rust::Vec<SceneToPickle>& scenes);

}  // namespace globalsplat
