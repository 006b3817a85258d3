//! Reader for the format of torch.save before torch 1.6, which later versions still write on request
//! (`_use_new_zipfile_serialization=False`): four pickles, which are a magic number, a version, the system, and the contents; a pickle with
//! the keys of the storages; and the storages in that order, each preceded by its number of elements in eight bytes.

use crate::pickle::{UnknownGlobals, unpickle};
use crate::value::Value;
use crate::{Storages, TorchFile};
use std::collections::HashMap;

/// Magic number of ten bytes, as a pickle of any protocol contains it.
const MAGIC: &[u8] = b"\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.";
/// Number of bytes at the start of a file that contain the magic number, which follows the protocol.
const PREFIX_LENGTH: usize = 32;
/// First byte of a pickle, the opcode that precedes the protocol.
const PROTO: u8 = 0x80;
/// Version of the format, not of torch.
const VERSION: i64 = 1001;

/// Returns `true` if `bytes` begin with the magic number.
pub(crate) fn is_legacy_file(bytes: &[u8]) -> bool {
    let prefix = &bytes[..bytes.len().min(PREFIX_LENGTH)];
    prefix.first() == Some(&PROTO) && prefix.windows(MAGIC.len()).any(|window| window == MAGIC)
}

/// Parses `bytes`, the contents of a file.
///
/// # Errors
/// Returns a description of what is wrong with the file.
pub(crate) fn parse(bytes: &[u8]) -> Result<TorchFile<'_>, String> {
    let mut rest = bytes;
    unpickle(&mut rest, UnknownGlobals::Refuse)?;
    let version = unpickle(&mut rest, UnknownGlobals::Refuse)?;
    if version.get(version.root) != &Value::Int(VERSION) {
        return Err("of an unknown version".into());
    }
    let system = unpickle(&mut rest, UnknownGlobals::Refuse)?;
    let Value::Dict(items) = system.get(system.root) else {
        return Err("without its system".into());
    };
    if system.find(items, "little_endian") != Some(&Value::Bool(true)) {
        return Err("with numbers that are not little-endian".into());
    }
    let values = unpickle(&mut rest, UnknownGlobals::Keep)?;
    let keys = unpickle(&mut rest, UnknownGlobals::Refuse)?;
    let Value::List(ids) = keys.get(keys.root) else { return Err("without the keys of its storages".into()) };

    let dtypes: HashMap<&str, _> = values
        .iter()
        .filter_map(|value| match value {
            &Value::Storage { dtype, key } => Some((key, dtype)),
            _ => None,
        })
        .collect();
    let mut storages = Storages::new();
    for &id in ids {
        let &Value::Str(key) = keys.get(id) else { return Err("with a key that is no string".into()) };
        let dtype = dtypes.get(key).ok_or_else(|| format!("with a storage {key} of an unknown type"))?;
        let cut = || format!("cut off in storage {key}");
        let (length, behind) = rest.split_first_chunk().ok_or_else(cut)?;
        let length = usize::try_from(i64::from_le_bytes(*length)).ok();
        let length = length.and_then(|count| count.checked_mul(dtype.size()));
        let start = bytes.len() - behind.len();
        rest = length.and_then(|length| behind.get(length..)).ok_or_else(cut)?;
        storages.insert(key.into(), start..bytes.len() - rest.len());
    }
    Ok(TorchFile { values, storages })
}
