//! Where the driver and NVRTC are.
//!
//! Loaders find a library by its name if it is on their path, or loaded already. NVRTC rarely is on the path, but it comes with torch:
//! it is loaded from there by its path, after the library that it loads itself, and then goes by its name.

use super::Result;
use std::ffi::{CStr, CString, c_void};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Whether the driver is there.
pub fn has_driver() -> bool {
    // SAFETY: it has no initializers that need anything.
    unsafe { cudarc::driver::sys::is_culib_present() }
}

/// Makes sure that NVRTC can be called.
///
/// # Errors
/// It isn't there.
pub fn load_nvrtc() -> Result<()> {
    static LOADED: OnceLock<bool> = OnceLock::new();
    // SAFETY: neither library has initializers that need anything.
    let is_there = || unsafe { cudarc::nvrtc::sys::is_culib_present() };
    let loaded = LOADED
        .get_or_init(|| is_there() || { folders().iter().any(|folder| load_from(folder)) && is_there() });
    if *loaded {
        return Ok(());
    }
    let folders: Vec<String> = folders().iter().map(|folder| folder.display().to_string()).collect();
    Err(format!(
        "NVRTC, which compiles for GPUs, is not on the loader's path and not in {}; a torch for CUDA brings it, or \
         `pip install nvidia-cuda-nvrtc`, or LD_LIBRARY_PATH names the folder of another",
        folders.join(", ")
    ))
}

/// Where torch, pip and NVIDIA's own packages put NVRTC.
fn folders() -> Vec<PathBuf> {
    let mut folders = vec![];
    if let Some(torch) = libtorch_folder() {
        // As in Python: site-packages/torch/lib and site-packages/nvidia/*/lib.
        if let Some(packages) = torch.ancestors().nth(2) {
            let entries = std::fs::read_dir(packages.join("nvidia")).into_iter().flatten().flatten();
            let mut beside: Vec<PathBuf> = entries.map(|entry| entry.path().join("lib")).collect();
            beside.sort();
            folders.extend(beside);
        }
        folders.push(torch);
    }
    folders.push("/usr/local/cuda/lib64".into());
    folders
}

/// Of the libtorch that this program runs with.
fn libtorch_folder() -> Option<PathBuf> {
    let mut origin = [0; libc::PATH_MAX as usize];
    // SAFETY: asks for a library that is loaded, and for a path that fits.
    let found = unsafe {
        let library = libc::dlopen(c"libtorch_cpu.so".as_ptr(), libc::RTLD_LAZY | libc::RTLD_NOLOAD);
        !library.is_null()
            && libc::dlinfo(library, libc::RTLD_DI_ORIGIN, origin.as_mut_ptr().cast::<c_void>()) == 0
    };
    // SAFETY: dlinfo ended it with a 0.
    let origin = || unsafe { CStr::from_ptr(origin.as_ptr()) };
    found
        .then(|| PathBuf::from(std::ffi::OsStr::from_bytes(origin().to_bytes())).canonicalize().ok())
        .flatten()
}

/// Loads NVRTC for good; false if it isn't there.
fn load_from(folder: &Path) -> bool {
    let named = |start: &str| {
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
        let mut found: Vec<PathBuf> = entries
            .filter(|path| {
                let name = path.file_name().unwrap_or_default().to_string_lossy();
                name.starts_with(start) && !name.contains(".alt.")
            })
            .collect();
        found.sort();
        found
    };
    let load = |path: &PathBuf| {
        let path = CString::new(path.as_os_str().as_bytes()).expect("a path holds no 0");
        // SAFETY: as in `load_nvrtc`.
        !unsafe { libc::dlopen(path.as_ptr(), libc::RTLD_LAZY | libc::RTLD_GLOBAL) }.is_null()
    };
    named("libnvrtc-builtins.so").iter().for_each(|path| {
        load(path);
    });
    named("libnvrtc.so").iter().any(load)
}
