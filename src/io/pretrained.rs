//! Locations of the pretrained weights of other networks.

use std::path::PathBuf;

/// Environment variable that names the folder of pretrained weights; if it is set, no other folder is searched.
pub const WEIGHTS_VARIABLE: &str = "GLOBALSPLAT_WEIGHTS";

/// Returns the folders that may contain pretrained weights, in order of preference.
pub fn pretrained_folders() -> Vec<PathBuf> {
    match std::env::var_os(WEIGHTS_VARIABLE) {
        Some(folder) => vec![folder.into()],
        None => vec!["weights".into(), concat!(env!("CARGO_MANIFEST_DIR"), "/weights").into()],
    }
}

/// Returns the file `name` in the first folder of pretrained weights that has it: the one that [`WEIGHTS_VARIABLE`] names, or else
/// `weights` in the current folder, or else the folder in which `make weights` put them when this program was built.
pub fn find_pretrained(name: &str) -> Option<PathBuf> {
    pretrained_folders().into_iter().map(|folder| folder.join(name)).find(|path| path.is_file())
}
