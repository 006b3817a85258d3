//! Reader for the format that torch.save wrote before torch 1.6. Later versions write it if `_use_new_zipfile_serialization=False`.
//!
//! A file contains, in this order:
//!
//! 1. five pickles: a magic number, the version of the format, properties of the system, the saved object, and the keys of the storages;
//! 2. the storages in the order of their keys, each preceded by its number of elements in eight bytes.

use crate::pickle::{UnknownGlobals, unpickle};
use crate::value::Value;
use crate::{Storages, TorchFile};
use std::collections::HashMap;

/// Pickle opcodes of the magic number, a LONG1 of ten bytes and a STOP. They are the same in every protocol from 2.
const MAGIC: &[u8] = b"\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.";
/// Number of bytes at the start of a file in which to look for the magic number. Opcodes of the pickle's header precede it.
const PREFIX_LENGTH: usize = 32;
/// Opcode PROTO, the first byte of a pickle. The number of the protocol follows it.
const PROTO: u8 = 0x80;
/// Supported version of the format.
const VERSION: i64 = 1001;

/// Returns `true` if `bytes` start with a pickle of the magic number.
pub(crate) fn is_legacy_file(bytes: &[u8]) -> bool {
    let prefix = &bytes[..bytes.len().min(PREFIX_LENGTH)];
    prefix.first() == Some(&PROTO) && prefix.windows(MAGIC.len()).any(|window| window == MAGIC)
}

/// Parses the contents of a file.
///
/// # Errors
/// Returns a phrase that describes the first fault of the file, such as "of an unknown version".
pub(crate) fn parse(bytes: &[u8]) -> Result<TorchFile<'_>, String> {
    let mut rest = bytes;
    unpickle(&mut rest, UnknownGlobals::Refuse)?; // the magic number
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
        let truncated = || format!("cut off in storage {key}");
        let (count, data) = rest.split_first_chunk().ok_or_else(truncated)?;
        let count = usize::try_from(i64::from_le_bytes(*count)).ok();
        let length = count.and_then(|count| count.checked_mul(dtype.size()));
        let start = bytes.len() - data.len();
        rest = length.and_then(|length| data.get(length..)).ok_or_else(truncated)?;
        storages.insert(key.into(), start..bytes.len() - rest.len());
    }
    Ok(TorchFile { values, storages })
}
