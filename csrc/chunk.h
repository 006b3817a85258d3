// RealEstate10K-style chunks: a torch.save file with a list of scenes, written by libtorch's pickler. They are read without torch by
// crates/capture/src/formats/chunk.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "rust/cxx.h"

namespace globalsplat {

// Shared with Rust, see src/chunk.rs.
struct SceneToPickle;

// Returns the bytes of a torch.save file with `scenes`.
std::unique_ptr<std::vector<uint8_t>> pickle_scenes(const rust::Vec<SceneToPickle>& scenes);

}  // namespace globalsplat
