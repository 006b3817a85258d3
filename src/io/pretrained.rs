//! Where networks that others trained are found.

use std::path::PathBuf;

/// Names the folder of pretrained weights; no other is looked at where it is set.
pub const WEIGHTS_VARIABLE: &str = "GLOBALSPLAT_WEIGHTS";

/// Folders in which pretrained weights may be, the first choice first.
pub fn pretrained_folders() -> Vec<PathBuf> {
    match std::env::var_os(WEIGHTS_VARIABLE) {
        Some(folder) => vec![folder.into()],
        None => vec!["weights".into(), concat!(env!("CARGO_MANIFEST_DIR"), "/weights").into()],
    }
}

/// The file of that name in the first folder of pretrained weights that has it: the one that [`WEIGHTS_VARIABLE`] names, else
/// `weights` here, else where `make weights` put them when this program was built.
pub fn find_pretrained(name: &str) -> Option<PathBuf> {
    pretrained_folders().into_iter().map(|folder| folder.join(name)).find(|path| path.is_file())
}
