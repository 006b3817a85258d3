//! Handwritten pickles, and archives of them.

use globalsplat_files::stored_zip;

/// Returns a BINUNICODE opcode with its argument.
pub fn text(text: &str) -> Vec<u8> {
    [b"X", &(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

/// Returns a BININT opcode with its argument.
pub fn int(value: u32) -> Vec<u8> {
    [b"J", &value.to_le_bytes()[..]].concat()
}

/// Returns a tensor of the storage with a persistent id of these parts.
pub fn tensor_of(id: &[Vec<u8>], offset: u32, size: &[u32], stride: &[u32]) -> Vec<u8> {
    let tuple = |values: &[u32]| {
        [b"(".to_vec(), values.iter().flat_map(|&v| int(v)).collect(), b"t".to_vec()].concat()
    };
    [
        b"ctorch._utils\n_rebuild_tensor_v2\n((".to_vec(),
        id.concat(),
        b"tQ".to_vec(),
        int(offset),
        tuple(size),
        tuple(stride),
        b"\x89ccollections\nOrderedDict\n)RtR".to_vec(),
    ]
    .concat()
}

/// Returns a torch.save archive with `pickle` and the bytes of one tensor.
pub fn archive(pickle: &[u8], data: &[u8]) -> Vec<u8> {
    stored_zip([("archive/data.pkl", pickle), ("archive/data/0", data)], 1)
}
