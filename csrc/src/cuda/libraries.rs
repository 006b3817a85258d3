//! Where the driver and NVRTC are.

use super::Result;
use libloading::os::unix::{Library, RTLD_GLOBAL, RTLD_LAZY};
use std::ffi::{CStr, c_char, c_int, c_uint, c_void};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// A program that NVRTC compiles.
pub type Program = *mut c_void;

/// What the driver makes: a context, a module, a kernel, a stream.
pub type Handle = *mut c_void;

/// Declares the functions of a library, and how they are looked up by their names.
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
    /// The driver's functions, as in its manual. They return 0 or the number of an error.
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
    /// NVRTC's functions, as in its manual. They return 0 or the number of an error.
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

/// Returns NVIDIA's driver, loaded once, as `libcuda.so.1`, as torch loads it: `libcuda.so` may be a CUDA toolkit's stub, which only
/// linkers use.
///
/// # Errors
/// It isn't there, or lacks a function.
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

/// NVRTC, loaded once: torch's own, which is of its CUDA, else the one on the loader's path.
///
/// # Errors
/// It isn't there, or lacks a function.
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
            "NVRTC, which compiles for GPUs, is not in {} and not on the loader's path; a torch for CUDA brings it, or `pip install \
             nvidia-cuda-nvrtc`, or LD_LIBRARY_PATH names the folder of another",
            folders.join(", ")
        )
    })
}

/// Where torch and pip put NVRTC.
fn folders() -> Vec<PathBuf> {
    let Some(torch) = libtorch_folder() else { return vec![] };
    // As in Python: site-packages/torch/lib and site-packages/nvidia/*/lib.
    let packages = torch.ancestors().nth(2).map(|packages| packages.join("nvidia"));
    let entries =
        packages.and_then(|packages| std::fs::read_dir(packages).ok()).into_iter().flatten().flatten();
    let mut folders: Vec<PathBuf> = entries.map(|entry| entry.path().join("lib")).collect();
    folders.sort();
    folders.insert(0, torch);
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

/// NVRTC of a folder, after the library that it asks for by name alone. In wheels it is called libnvrtc.so.13, in libtorch's archives
/// libnvrtc-<digits>.so.13.
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
    // SAFETY: these libraries have no initializers that need anything.
    unsafe { Library::open(Some(path), RTLD_LAZY | RTLD_GLOBAL) }.ok()
}
