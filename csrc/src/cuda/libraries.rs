//! Lookup and loading of the CUDA driver and of NVRTC.

use super::Result;
use libloading::os::unix::{Library, RTLD_GLOBAL, RTLD_LAZY};
use std::ffi::{c_char, c_int, c_uint, c_void};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Handle of a program that NVRTC compiles.
pub type Program = *mut c_void;

/// Handle of a driver object: a context, a module, a kernel, a stream.
pub type Handle = *mut c_void;

/// Declares a table of a library's functions, and their lookup by name.
macro_rules! functions {
    ($(#[$about:meta])* $table:ident, $library:literal: $($name:ident ( $($parameter:ty),* ) -> $result:ty;)*) => {
        $(#[$about])*
        #[allow(non_snake_case)]
        pub struct $table {
            $(pub $name: unsafe extern "C" fn($($parameter),*) -> $result,)*
        }

        impl $table {
            /// Looks up every function of `library`, which is never unloaded.
            fn of(library: Library) -> Result<Self> {
                // SAFETY: the functions have these parameters, and the library is never unloaded.
                let functions = unsafe {
                    $table {
                        $($name: *library
                            .get(concat!(stringify!($name), "\0").as_bytes())
                            .map_err(|e| format!(concat!($library, " is too old: {}"), e))?,)*
                    }
                };
                std::mem::forget(library);
                Ok(functions)
            }
        }
    };
}

functions! {
    /// Functions of the CUDA driver, as in its manual. They return 0 or an error code.
    DriverFunctions, "NVIDIA's driver":
    cuInit(c_uint) -> c_int;
    cuDriverGetVersion(*mut c_int) -> c_int;
    cuDeviceGetCount(*mut c_int) -> c_int;
    cuDeviceGet(*mut c_int, c_int) -> c_int;
    cuDeviceGetName(*mut c_char, c_int, c_int) -> c_int;
    cuDeviceTotalMem_v2(*mut usize, c_int) -> c_int;
    cuDeviceGetAttribute(*mut c_int, c_int, c_int) -> c_int;
    cuDevicePrimaryCtxRetain(*mut Handle, c_int) -> c_int;
    cuCtxSetCurrent(Handle) -> c_int;
    cuModuleLoadData(*mut Handle, *const c_void) -> c_int;
    cuModuleGetFunction(*mut Handle, Handle, *const c_char) -> c_int;
    cuLaunchKernel(Handle, c_uint, c_uint, c_uint, c_uint, c_uint, c_uint, c_uint, Handle, *mut *mut c_void, *mut *mut c_void) -> c_int;
    cuGetErrorName(c_int, *mut *const c_char) -> c_int;
    cuGetErrorString(c_int, *mut *const c_char) -> c_int;
}

functions! {
    /// Functions of NVRTC, as in its manual. They return 0 or an error code.
    NvrtcFunctions, "NVRTC":
    nvrtcVersion(*mut c_int, *mut c_int) -> c_int;
    nvrtcGetNumSupportedArchs(*mut c_int) -> c_int;
    nvrtcGetSupportedArchs(*mut c_int) -> c_int;
    nvrtcGetErrorString(c_int) -> *const c_char;
    nvrtcCreateProgram(*mut Program, *const c_char, *const c_char, c_int, *const *const c_char, *const *const c_char) -> c_int;
    nvrtcCompileProgram(Program, c_int, *const *const c_char) -> c_int;
    nvrtcDestroyProgram(*mut Program) -> c_int;
    nvrtcGetProgramLogSize(Program, *mut usize) -> c_int;
    nvrtcGetProgramLog(Program, *mut c_char) -> c_int;
    nvrtcGetCUBINSize(Program, *mut usize) -> c_int;
    nvrtcGetCUBIN(Program, *mut c_char) -> c_int;
    nvrtcGetPTXSize(Program, *mut usize) -> c_int;
    nvrtcGetPTX(Program, *mut c_char) -> c_int;
}

/// Returns NVIDIA's driver, which is loaded once, as `libcuda.so.1` like torch loads it: `libcuda.so` may be a CUDA toolkit's stub for
/// linking.
///
/// # Errors
/// Returns an error if the driver is missing or lacks a function.
pub fn driver() -> Result<&'static DriverFunctions> {
    static LOADED: OnceLock<Result<DriverFunctions>> = OnceLock::new();
    let load = || {
        let library = load(Path::new("libcuda.so.1")).ok_or(
            "NVIDIA's driver (libcuda.so.1) is not on the loader's path; it comes with the system, as a package or by NVIDIA's \
             installer, and into a container by nvidia-container-toolkit",
        )?;
        DriverFunctions::of(library)
    };
    LOADED.get_or_init(load).as_ref().map_err(String::clone)
}

/// Returns NVRTC, which is loaded once: torch's own, which matches its CUDA version, or else the one on the loader's path.
///
/// # Errors
/// Returns an error if NVRTC is missing or lacks a function.
pub fn nvrtc() -> Result<&'static NvrtcFunctions> {
    static LOADED: OnceLock<Result<NvrtcFunctions>> = OnceLock::new();
    LOADED.get_or_init(|| NvrtcFunctions::of(load_nvrtc()?)).as_ref().map_err(String::clone)
}

fn load_nvrtc() -> Result<Library> {
    let folders = folders();
    let by_name = ["libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so"].map(Path::new);
    let found = folders.iter().find_map(|folder| load_from(folder));
    found.or_else(|| by_name.into_iter().find_map(load)).ok_or_else(|| {
        let folders: Vec<String> = folders.iter().map(|folder| folder.display().to_string()).collect();
        format!(
            "NVRTC not found in {} or on the library search path: install a CUDA build of torch or `pip install nvidia-cuda-nvrtc`, or \
             add NVRTC's folder to LD_LIBRARY_PATH",
            folders.join(", ")
        )
    })
}

/// Returns the folders where torch and pip install NVRTC.
fn folders() -> Vec<PathBuf> {
    let Some(torch) = libtorch_folder() else { return vec![] };
    // Python environments have site-packages/torch/lib and site-packages/nvidia/*/lib.
    let packages = torch.ancestors().nth(2).map(|packages| packages.join("nvidia"));
    let entries =
        packages.and_then(|packages| std::fs::read_dir(packages).ok()).into_iter().flatten().flatten();
    let mut folders: Vec<PathBuf> = entries.map(|entry| entry.path().join("lib")).collect();
    folders.sort();
    folders.insert(0, torch);
    folders
}

/// Returns `None`: libtorch has no part for NVIDIA's GPUs on this system.
#[cfg(not(target_os = "linux"))]
fn libtorch_folder() -> Option<PathBuf> {
    None
}

/// Returns the folder of the libtorch that is loaded into this process.
#[cfg(target_os = "linux")]
fn libtorch_folder() -> Option<PathBuf> {
    use std::ffi::{CStr, OsStr};
    use std::os::unix::ffi::OsStrExt;
    let mut origin = [0; libc::PATH_MAX as usize];
    // SAFETY: the library is only looked up, not loaded, and the path fits into the buffer.
    let found = unsafe {
        let library = libc::dlopen(c"libtorch_cpu.so".as_ptr(), libc::RTLD_LAZY | libc::RTLD_NOLOAD);
        !library.is_null()
            && libc::dlinfo(library, libc::RTLD_DI_ORIGIN, origin.as_mut_ptr().cast::<c_void>()) == 0
    };
    // SAFETY: dlinfo has terminated the string with a 0.
    let origin = || unsafe { CStr::from_ptr(origin.as_ptr()) };
    found.then(|| PathBuf::from(OsStr::from_bytes(origin().to_bytes())).canonicalize().ok()).flatten()
}

/// Loads NVRTC from a folder, preceded by its builtins library, which it opens by name only. The file is called libnvrtc.so.13 in wheels
/// and libnvrtc-<digits>.so.13 in libtorch's archives.
fn load_from(folder: &Path) -> Option<Library> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries
        .filter_map(|entry| entry.file_name().into_string().ok())
        .filter(|name| !name.contains(".alt."))
        .collect();
    names.sort();
    let (builtins, others): (Vec<_>, Vec<_>) = names
        .iter()
        .filter(|name| name.starts_with("libnvrtc") && name.contains(".so"))
        .partition(|name| name.starts_with("libnvrtc-builtins"));
    builtins.iter().filter_map(|name| load(&folder.join(name))).for_each(std::mem::forget);
    others.iter().find_map(|name| load(&folder.join(name)))
}

fn load(path: &Path) -> Option<Library> {
    // SAFETY: the initializers of these libraries have no requirements.
    unsafe { Library::open(Some(path), RTLD_LAZY | RTLD_GLOBAL) }.ok()
}
