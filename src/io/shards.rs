//! Weights that are too large for one file: several files, and an index of which tensor is in which file, in the format of Hugging Face's
//! libraries.

use super::weights::{Weights, write_weights, write_weights_partially};
use super::weights_file::{INDEX_ENDING, ShardIndex};
use super::write_json;
use crate::error::{Error, Result};
use globalsplat_files::PartialFile;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tch::Tensor;

/// Returns the path of the index of the shards that [`write_sharded`] writes for `path`, or `None` if its name doesn't end in
/// `.safetensors`.
pub fn shard_index(path: &Path) -> Option<PathBuf> {
    let ending = path.extension()?;
    let stem = path.file_stem()?.to_string_lossy();
    ending.eq_ignore_ascii_case("safetensors").then(|| path.with_file_name(format!("{stem}{INDEX_ENDING}")))
}

/// Writes `weights` to `path`, a `*.safetensors`. If they have more than `most` bytes, writes files of at most `most` bytes beside it
/// (`*-00001-of-00003.safetensors`) and their index instead. A tensor that is larger by itself has its own file. Returns the path of what
/// was written: the file, or the index, which is written last.
///
/// # Errors
/// Returns an error if a file exists at `path` that would be taken for the shards, if a name for shards doesn't end in `.safetensors`, or
/// if a file can't be written.
pub fn write_sharded(path: &Path, weights: &Weights, most: u64) -> Result<PathBuf> {
    let bytes = |tensor: &Tensor| (tensor.numel() * tensor.kind().elt_size_in_bytes()) as u64;
    let total: u64 = weights.tensors.values().map(bytes).sum();
    if total <= most {
        write_weights(path, &weights.tensors, weights.metadata.clone())?;
        return Ok(path.to_owned());
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let Some(index) = shard_index(path) else {
        return Err(Error::input(path, "the name", name, "one that ends in .safetensors, for shards"));
    };
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    if path.exists() {
        let expected = "no file: it would be read instead of the shards";
        return Err(Error::input(path, "the output", "a file", expected));
    }
    let mut shards: Vec<BTreeMap<String, Tensor>> = vec![];
    let mut remaining = 0;
    for (name, tensor) in &weights.tensors {
        if shards.is_empty() || bytes(tensor) > remaining {
            shards.push(BTreeMap::new());
            remaining = most;
        }
        remaining = remaining.saturating_sub(bytes(tensor));
        shards.last_mut().expect("one at least").insert(name.clone(), tensor.shallow_clone());
    }
    let (mut weight_map, mut written) = (BTreeMap::new(), vec![]);
    for (number, shard) in shards.iter().enumerate() {
        let name = format!("{stem}-{:05}-of-{:05}.safetensors", number + 1, shards.len());
        let metadata = weights.metadata.clone();
        written.push(write_weights_partially(&path.with_file_name(&name), shard, metadata)?);
        weight_map.extend(shard.keys().map(|tensor| (tensor.clone(), name.clone())));
    }
    // An index from before would describe other files.
    if index.exists() {
        std::fs::remove_file(&index).map_err(Error::write(&index))?;
    }
    written.into_iter().try_for_each(PartialFile::persist)?;
    let metadata = [("total_size".to_string(), total.into())].into_iter().collect();
    write_json(&index, &ShardIndex { metadata, weight_map })?;
    Ok(index)
}
