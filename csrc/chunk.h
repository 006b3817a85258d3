// RealEstate10K-style chunks: a torch.save file with a list of scenes, written by libtorch's own pickler. Reading them needs no
// torch and is src/data/formats/chunk's.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "rust/cxx.h"

namespace globalsplat {

// Shared with Rust, see src/chunk.rs.
struct SceneToPickle;

// The bytes of a torch.save file that holds `scenes`.
std::unique_ptr<std::vector<uint8_t>> pickle_scenes(const rust::Vec<SceneToPickle>& scenes);

}  // namespace globalsplat
