//! Extraction of weights from a checkpoint of torch.save: a Lightning checkpoint, a plain state dict, or one under another customary key.

use crate::error::{Error, Result};
use globalsplat_torch_file::{Array, TorchFile, Value};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;

/// Arrays by name, and metadata.
pub(super) type Contents = (BTreeMap<String, Array>, HashMap<String, String>);

/// Keys under which a checkpoint may hold its state dict. Lightning uses the first.
const STATE_DICT_KEYS: [&str; 3] = ["state_dict", "model_state_dict", "model"];
/// Names of settings that the shapes of weights don't determine. A setting is used wherever it occurs in a checkpoint, if all occurrences
/// have the same value.
const SETTINGS: [&str; 1] = ["num_heads"];

/// Returns the tensors of the state dict in `file`, which was read from `path`. The metadata are the strings beside the state dict, and
/// settings.
///
/// # Errors
/// Returns an error if there is no state dict, or if a tensor is broken.
pub(super) fn state_dict(file: &TorchFile, path: &Path) -> Result<Contents> {
    let TorchFile { values, storages } = file;
    let refuse = |found: &str| {
        Err(Error::input(path, "the contents", found, "a state dict, or a checkpoint with a state_dict"))
    };
    let root = match values.get(values.root) {
        Value::Dict(items) => items,
        other => return refuse(other.type_name()),
    };
    let inner = STATE_DICT_KEYS.iter().find_map(|place| match values.find(root, place) {
        Some(Value::Dict(items)) => Some(items),
        _ => None,
    });
    let mut arrays = BTreeMap::new();
    for &(key, value) in inner.unwrap_or(root) {
        let (&Value::Str(name), tensor @ Value::Tensor { .. }) = (values.get(key), values.get(value)) else {
            continue;
        };
        let array = Array::locate(values, storages, tensor).map_err(|why| {
            Error::input(path, format!("tensor {name}"), format!("broken: it {why}"), "a whole one")
        })?;
        arrays.insert(name.to_string(), array);
    }
    if arrays.is_empty() {
        return refuse("a dict without tensors");
    }
    let mut metadata = HashMap::new();
    for &(key, value) in root {
        if let (&Value::Str(key), &Value::Str(text)) = (values.get(key), values.get(value)) {
            metadata.insert(key.to_string(), text.to_string());
        }
    }
    for setting in SETTINGS {
        let said = values.iter().filter_map(|value| match value {
            Value::Dict(items) | Value::Object(items) => values.find(items, setting),
            _ => None,
        });
        let said: BTreeSet<i64> = said.filter_map(Value::as_int).collect();
        if let (Some(number), 1) = (said.first(), said.len()) {
            metadata.insert(setting.to_string(), number.to_string());
        }
    }
    Ok((arrays, metadata))
}
