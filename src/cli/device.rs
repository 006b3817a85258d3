//! Parser of `--device cpu|cuda[:N]`.

use crate::{Error, Result};
use std::ffi::CStr;
use tch::{Cuda, Device};

/// Parses a device and checks that it is available.
pub fn parse(name: &str) -> Result<Device> {
    let refused = |why: &str| Error::request(format!("--device {name}: {why}"));
    let index = match name.split_once(':') {
        None if name == "cpu" => return Ok(Device::Cpu),
        None if name == "cuda" => 0,
        Some(("cuda", index)) => {
            index.parse::<usize>().map_err(|_| refused("expected cuda:N with a whole number"))?
        }
        _ => return Err(refused("expected cpu, cuda or cuda:N")),
    };
    let why = load_cuda().err().unwrap_or("run globalsplat doctor for details".into());
    let count = Cuda::device_count();
    if !Cuda::is_available() || index as i64 >= count {
        return Err(refused(&format!("there are {count} CUDA devices that this libtorch can use ({why})")));
    }
    Ok(Device::Cuda(index))
}

/// Loads libtorch's CUDA library if there is one, or returns why it can't be loaded. The program isn't linked to it: loading it
/// takes longer than a small job on the CPU, and machines without a GPU may not have it.
pub fn load_cuda() -> Result<(), String> {
    // SAFETY: the name is a terminated string, and the library's initializers only register themselves with libtorch.
    let loaded = unsafe { libc::dlopen(c"libtorch_cuda.so".as_ptr(), libc::RTLD_NOW | libc::RTLD_GLOBAL) };
    if !loaded.is_null() {
        return Ok(());
    }
    // SAFETY: dlerror returns a terminated string, and nothing else calls it before the string is copied.
    let words = unsafe { CStr::from_ptr(libc::dlerror()) };
    Err(format!("libtorch's CUDA library can't be loaded: {}", words.to_string_lossy()))
}
