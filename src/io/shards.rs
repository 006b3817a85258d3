//! Weights too large for one file: several, and an index that says which tensor is where, as Hugging Face's libraries write and read
//! them.

use super::weights::{Weights, write_weights};
use super::weights_file::{INDEX_ENDING, ShardIndex};
use super::write_json;
use crate::error::{Error, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tch::Tensor;

/// Writes `weights` to `path`, a `*.safetensors`, or, where they have more bytes than `most`, to files of no more beside it
/// (`*-00001-of-00003.safetensors`) and their index. A tensor that is larger by itself has a file of its own. What was written is
/// returned: the file, or the index, which comes last.
///
/// # Errors
/// A file that stands where the index would say there is none, a name that doesn't end in `.safetensors`, or the system's refusal to
/// write.
pub fn write_sharded(path: &Path, weights: &Weights, most: u64) -> Result<PathBuf> {
    let bytes = |tensor: &Tensor| (tensor.numel() * tensor.kind().elt_size_in_bytes()) as u64;
    let total: u64 = weights.tensors.values().map(bytes).sum();
    if total <= most {
        write_weights(path, &weights.tensors, weights.metadata.clone())?;
        return Ok(path.to_owned());
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let Some(stem) = name.strip_suffix(".safetensors") else {
        return Err(Error::input(path, "the name", name, "one that ends in .safetensors, for shards"));
    };
    if path.exists() {
        let expected = "none: it would be taken for the shards that are to be written";
        return Err(Error::input(path, "the output", "a file", expected));
    }
    let mut shards: Vec<BTreeMap<String, Tensor>> = vec![];
    let mut room = 0;
    for (name, tensor) in &weights.tensors {
        if shards.is_empty() || bytes(tensor) > room {
            shards.push(BTreeMap::new());
            room = most;
        }
        room = room.saturating_sub(bytes(tensor));
        shards.last_mut().expect("one at least").insert(name.clone(), tensor.shallow_clone());
    }
    let index = path.with_file_name(format!("{stem}{INDEX_ENDING}"));
    // One of before would describe other files.
    if index.exists() {
        std::fs::remove_file(&index).map_err(Error::write(&index))?;
    }
    let mut weight_map = BTreeMap::new();
    for (number, shard) in shards.iter().enumerate() {
        let name = format!("{stem}-{:05}-of-{:05}.safetensors", number + 1, shards.len());
        write_weights(&path.with_file_name(&name), shard, weights.metadata.clone())?;
        weight_map.extend(shard.keys().map(|tensor| (tensor.clone(), name.clone())));
    }
    let metadata = [("total_size".to_string(), total.into())].into_iter().collect();
    write_json(&index, &ShardIndex { metadata, weight_map })?;
    Ok(index)
}
