//! GPUs, by the driver, and launches on them.

use super::{
    Result, cache,
    compile::{Form, Nvrtc},
    ffi::BlockCounts,
    libraries::has_driver,
};
use cudarc::driver::{
    result::{self, DriverError},
    sys,
};
use std::collections::{HashMap, hash_map::Entry};
use std::ffi::{CString, c_void};
use std::path::PathBuf;
use std::sync::{LazyLock, Mutex, PoisonError};

/// What the driver says of itself and of the GPUs.
#[derive(Debug)]
pub struct Driver {
    /// The CUDA that it serves at the most, as in 13000 for 13.0.
    pub version: i32,
    /// In the order of their numbers.
    pub gpus: Vec<Gpu>,
}

/// A device.
#[derive(Debug)]
pub struct Gpu {
    /// As in `NVIDIA H100 80GB HBM3`.
    pub name: String,
    /// Compute capability, as in 90 for 9.0.
    pub architecture: i32,
    /// Bytes of memory.
    pub memory: usize,
    /// Multiprocessors.
    pub multiprocessors: i32,
}

impl Driver {
    /// Asks the driver.
    ///
    /// # Errors
    /// There is none, or it can't reach the GPUs.
    pub fn find() -> Result<Self> {
        if !has_driver() {
            return Err("NVIDIA's driver (libcuda.so.1) is not on the loader's path; it comes with the system, as a package or by \
                        NVIDIA's installer, and into a container by nvidia-container-toolkit"
                .into());
        }
        let count = match result::init() {
            Err(DriverError(sys::CUresult::CUDA_ERROR_NO_DEVICE)) => 0,
            started => told(started.and_then(|()| result::device::get_count()))?,
        };
        let gpus = (0..count).map(Gpu::find).collect::<Result<Vec<_>>>()?;
        Ok(Driver { version: driver_version()?, gpus })
    }
}

impl Gpu {
    fn find(number: i32) -> Result<Self> {
        use sys::CUdevice_attribute as Attribute;
        let device = told(result::device::get(number))?;
        // SAFETY: a device that the driver gave.
        let attribute =
            |attribute: Attribute| told(unsafe { result::device::get_attribute(device, attribute) });
        Ok(Gpu {
            name: told(result::device::get_name(device))?,
            architecture: 10 * attribute(Attribute::CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR)?
                + attribute(Attribute::CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MINOR)?,
            // SAFETY: as above.
            memory: told(unsafe { result::device::total_mem(device) })?,
            multiprocessors: attribute(Attribute::CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT)?,
        })
    }
}

fn driver_version() -> Result<i32> {
    let mut version = 0;
    // SAFETY: the driver is there.
    told(unsafe { sys::cuDriverGetVersion(&mut version) }.result())?;
    Ok(version)
}

fn told<T>(result: std::result::Result<T, DriverError>) -> Result<T> {
    result.map_err(|error| {
        let words = [error.error_string(), error.error_name()]
            .map(|text| text.map_or("unknown".into(), |text| text.to_string_lossy().into_owned()));
        format!("CUDA's driver fails: {}", words.join(", "))
    })
}

/// The kernels on one device.
struct Loaded {
    /// The one that torch uses, too.
    context: sys::CUcontext,
    module: sys::CUmodule,
    functions: HashMap<String, sys::CUfunction>,
}

// SAFETY: what the driver gives belongs to the process, not to a thread.
unsafe impl Send for Loaded {}

/// Where the kernels of a device came from.
#[derive(Debug)]
pub struct Prepared {
    /// The architecture that they were compiled for, as in 90.
    pub architecture: i32,
    /// The file that keeps them, if one does.
    pub file: Option<PathBuf>,
    /// Whether they were read from it.
    pub was_kept: bool,
}

impl Loaded {
    fn on(number: i32) -> Result<(Self, Prepared)> {
        let driver = Driver::find()?;
        let known = driver.gpus.len();
        let gpu = driver
            .gpus
            .get(number as usize)
            .ok_or(format!("there are {known} GPUs, not one of number {number}"))?;
        let nvrtc = Nvrtc::find()?;
        let (architecture, form) = nvrtc.target(gpu.architecture)?;
        let file = cache::cache_folder()
            .map(|folder| folder.join(cache::file_name(&nvrtc, driver.version, architecture, form)));
        // SAFETY: a device that is there; its context is kept for good.
        let context = told(unsafe {
            result::device::get(number).and_then(|device| {
                let context = result::primary_ctx::retain(device)?;
                result::ctx::set_current(context).map(|()| context)
            })
        })?;
        // SAFETY: whole images, of which PTX ends with a 0.
        let load = |image: &[u8]| told(unsafe { result::module::load_data(image.as_ptr().cast()) });
        let kept = file.as_deref().and_then(cache::read).and_then(|image| load(&image).ok());
        let was_kept = kept.is_some();
        let (module, file) = match kept {
            Some(module) => (module, file),
            None => {
                let mut image = nvrtc.compile(architecture, form)?.image;
                let mut module = load(&image);
                // A driver that is older than NVRTC may refuse its machine code, and compile for itself.
                if module.is_err() && form == Form::Cubin {
                    image = nvrtc.compile(architecture, Form::Ptx)?.image;
                    module = load(&image);
                }
                (module?, file.filter(|file| cache::write(file, &image)))
            }
        };
        let functions = HashMap::new();
        Ok((Loaded { context, module, functions }, Prepared { architecture, file, was_kept }))
    }

    fn function(&mut self, kernel: &str) -> Result<sys::CUfunction> {
        if let Some(&function) = self.functions.get(kernel) {
            return Ok(function);
        }
        let name = CString::new(kernel).map_err(|e| e.to_string())?;
        // SAFETY: a module that is loaded.
        let function = told(unsafe { result::module::get_function(self.module, name) })?;
        self.functions.insert(kernel.into(), function);
        Ok(function)
    }
}

static DEVICES: LazyLock<Mutex<HashMap<i32, Loaded>>> = LazyLock::new(Default::default);

/// Compiles the kernels for a device, by its number, and loads them, or loads those that were kept.
///
/// # Errors
/// What is missing, or what the compiler or the driver refuses.
pub fn prepare(device: i32) -> Result<Prepared> {
    let (loaded, prepared) = Loaded::on(device)?;
    DEVICES.lock().unwrap_or_else(PoisonError::into_inner).insert(device, loaded);
    Ok(prepared)
}

/// See `launch_kernel` in the bridge.
///
/// # Safety
/// A stream of the device, and as many arguments as the kernel has, of its types.
pub unsafe fn launch_kernel(
    device: i32,
    stream: usize,
    kernel: &str,
    blocks: BlockCounts,
    threads: u32,
    arguments: usize,
) -> Result<()> {
    let mut devices = DEVICES.lock().unwrap_or_else(PoisonError::into_inner);
    let loaded = match devices.entry(device) {
        Entry::Occupied(known) => known.into_mut(),
        Entry::Vacant(place) => place.insert(Loaded::on(device)?.0),
    };
    let function = loaded.function(kernel)?;
    // SAFETY: the caller's promise.
    told(unsafe {
        result::ctx::set_current(loaded.context).and_then(|()| {
            let (shared_bytes, extra) = (0, std::ptr::null_mut());
            let (stream, arguments) = (stream as sys::CUstream, arguments as *mut *mut c_void);
            sys::cuLaunchKernel(
                function,
                blocks.x,
                blocks.y,
                1,
                threads,
                1,
                1,
                shared_bytes,
                stream,
                arguments,
                extra,
            )
            .result()
        })
    })
    .map_err(|error| format!("{kernel}: {error}"))
}
