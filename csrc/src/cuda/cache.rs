//! On-disk cache of compiled kernels: they are compiled once per machine, not at every start.

use super::compile::{CodeFormat, Nvrtc, compile_inputs};
use sha2::{Digest, Sha256};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Length in bytes of the digest at the start of a file.
const DIGEST: usize = 32;

/// Returns the cache folder, $XDG_CACHE_HOME/globalsplat or ~/.cache/globalsplat; `None` if neither variable is set.
pub fn cache_folder() -> Option<PathBuf> {
    let named = |variable| std::env::var_os(variable).filter(|path| !path.is_empty()).map(PathBuf::from);
    let caches = named("XDG_CACHE_HOME").or_else(|| named("HOME").map(|home| home.join(".cache")))?;
    Some(caches.join("globalsplat"))
}

/// Returns the file name for the current kernel sources, compiled for this architecture, format and driver version.
pub fn file_name(nvrtc: &Nvrtc, driver: i32, architecture: i32, format: CodeFormat) -> String {
    let mut digest = Sha256::new();
    for part in compile_inputs(architecture, format) {
        digest.update((part.len() as u64).to_le_bytes());
        digest.update(part);
    }
    digest.update(format!("{:?} {driver}", nvrtc.version));
    let mut name = String::from("kernels-");
    for byte in &digest.finalize()[..12] {
        write!(name, "{byte:02x}").expect("a string takes all");
    }
    name
}

/// Reads a cached image; `None` if the file is missing, incomplete or corrupt.
pub fn read(file: &Path) -> Option<Vec<u8>> {
    let mut bytes = std::fs::read(file).ok()?;
    let image = bytes.split_off(DIGEST.min(bytes.len()));
    (Sha256::digest(&image)[..] == bytes[..]).then_some(image)
}

/// Stores a compiled image and returns `true` on success. After a failure the next start compiles again.
pub fn write(file: &Path, image: &[u8]) -> bool {
    let Some(folder) = file.parent() else { return false };
    let part = file.with_extension(format!("{}.part", std::process::id()));
    let bytes = [&Sha256::digest(image)[..], image].concat();
    let stored = std::fs::create_dir_all(folder)
        .and_then(|()| std::fs::write(&part, bytes))
        .and_then(|()| std::fs::rename(&part, file));
    if stored.is_err() {
        let _ = std::fs::remove_file(part);
    }
    stored.is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corrupt_cache_files_are_ignored() {
        let folder = std::env::temp_dir().join(format!("globalsplat-cache-{}", std::process::id()));
        let file = folder.join("deeper/kernels");
        assert_eq!(read(&file), None);
        assert!(write(&file, b"machine code"));
        assert_eq!(read(&file).as_deref(), Some(&b"machine code"[..]));
        let whole = std::fs::read(&file).unwrap();
        std::fs::write(&file, &whole[..whole.len() - 1]).unwrap();
        assert_eq!(read(&file), None);
        for place in 0..whole.len() {
            let mut harmed = whole.clone();
            harmed[place] ^= 1;
            std::fs::write(&file, harmed).unwrap();
            assert_eq!(read(&file), None, "byte {place}");
        }
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn every_compile_input_changes_the_file_name() {
        let nvrtc = Nvrtc { version: (13, 0), architectures: vec![75, 90] };
        let newer = Nvrtc { version: (13, 1), ..nvrtc.clone() };
        let mut names = vec![
            file_name(&nvrtc, 13000, 90, CodeFormat::Cubin),
            file_name(&newer, 13000, 90, CodeFormat::Cubin),
            file_name(&nvrtc, 13010, 90, CodeFormat::Cubin),
            file_name(&nvrtc, 13000, 75, CodeFormat::Cubin),
            file_name(&nvrtc, 13000, 90, CodeFormat::Ptx),
        ];
        assert_eq!(names[0], file_name(&nvrtc.clone(), 13000, 90, CodeFormat::Cubin));
        names.sort();
        names.dedup();
        assert_eq!(names.len(), 5);
    }
}
