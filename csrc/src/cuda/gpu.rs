//! GPUs as the driver reports them, and kernel launches on them.

use super::{
    Result, cache,
    compile::{CodeFormat, Nvrtc},
    libraries::{DriverFunctions, Handle, driver},
};
use std::collections::{HashMap, hash_map::Entry};
use std::ffi::{CStr, CString, c_char, c_int};
use std::path::PathBuf;
use std::ptr::null_mut;
use std::sync::{LazyLock, Mutex, PoisonError};

// Values from cuda.h.
const CUDA_ERROR_NO_DEVICE: c_int = 100;
const MULTIPROCESSOR_COUNT: c_int = 16;
const COMPUTE_CAPABILITY_MAJOR: c_int = 75;
const COMPUTE_CAPABILITY_MINOR: c_int = 76;

/// Version of the CUDA driver, and the GPUs that it reports.
#[derive(Debug)]
pub struct Driver {
    /// Newest supported CUDA version, as in 13000 for 13.0.
    pub version: i32,
    /// GPUs in the order of their indices.
    pub gpus: Vec<Gpu>,
}

/// Properties of a GPU.
#[derive(Debug)]
pub struct Gpu {
    /// Name, as in `NVIDIA H100 80GB HBM3`.
    pub name: String,
    /// Compute capability, as in 90 for 9.0.
    pub architecture: i32,
    /// Memory in bytes.
    pub memory: usize,
    /// Number of multiprocessors.
    pub multiprocessors: i32,
}

impl Driver {
    /// Queries the driver.
    ///
    /// # Errors
    /// Returns an error if there is no driver or it can't reach the GPUs.
    pub fn find() -> Result<Self> {
        let driver = driver()?;
        let (mut count, mut version) = (0, 0);
        // SAFETY: every output argument points to a variable of the right type.
        unsafe {
            match (driver.cuInit)(0) {
                CUDA_ERROR_NO_DEVICE => {}
                started => {
                    driver.check(started)?;
                    driver.check((driver.cuDeviceGetCount)(&mut count))?;
                }
            }
            driver.check((driver.cuDriverGetVersion)(&mut version))?;
        }
        let gpus = (0..count).map(|number| Gpu::find(driver, number)).collect::<Result<Vec<_>>>()?;
        Ok(Driver { version, gpus })
    }
}

impl Gpu {
    fn find(driver: &DriverFunctions, number: c_int) -> Result<Self> {
        let (mut device, mut memory, mut name) = (0, 0, [0; 256]);
        // SAFETY: `number` is a valid device index, and every output argument points to a variable or buffer of the right size.
        unsafe {
            driver.check((driver.cuDeviceGet)(&mut device, number))?;
            driver.check((driver.cuDeviceTotalMem_v2)(&mut memory, device))?;
            driver.check((driver.cuDeviceGetName)(name.as_mut_ptr(), name.len() as c_int, device))?;
        }
        let attribute = |attribute| {
            let mut value = 0;
            // SAFETY: as above.
            driver.check(unsafe { (driver.cuDeviceGetAttribute)(&mut value, attribute, device) })?;
            Ok::<_, String>(value)
        };
        Ok(Gpu {
            // SAFETY: the driver has terminated the string with a 0.
            name: unsafe { CStr::from_ptr(name.as_ptr()) }.to_string_lossy().into_owned(),
            architecture: 10 * attribute(COMPUTE_CAPABILITY_MAJOR)? + attribute(COMPUTE_CAPABILITY_MINOR)?,
            memory,
            multiprocessors: attribute(MULTIPROCESSOR_COUNT)?,
        })
    }
}

impl DriverFunctions {
    /// Converts a result code of the driver to a `Result` with an error message.
    fn check(&self, status: c_int) -> Result<()> {
        if status == 0 {
            return Ok(());
        }
        let words = [self.cuGetErrorString, self.cuGetErrorName].map(|ask| {
            let mut text: *const c_char = null_mut();
            // SAFETY: the driver sets a static string, or null.
            unsafe {
                ask(status, &mut text);
                if text.is_null() { "unknown".into() } else { CStr::from_ptr(text).to_string_lossy() }
            }
        });
        Err(format!("the CUDA driver failed: {}", words.join(", ")))
    }
}

/// Kernels that are loaded on one device.
struct LoadedKernels {
    /// Primary context of the device, which torch uses, too.
    context: Handle,
    module: Handle,
    kernels: HashMap<String, Handle>,
}

// SAFETY: handles of the driver belong to the process, not to a thread.
unsafe impl Send for LoadedKernels {}

/// Origin of the kernels of a device.
#[derive(Debug)]
pub struct KernelOrigin {
    /// Architecture that they were compiled for, as in 90.
    pub architecture: i32,
    /// Cache file of the kernels, if there is one.
    pub file: Option<PathBuf>,
    /// `true` if the kernels were read from the cache file.
    pub was_cached: bool,
}

impl LoadedKernels {
    fn load(number: i32) -> Result<(Self, KernelOrigin)> {
        let found = Driver::find()?;
        let known = found.gpus.len();
        let gpu = found
            .gpus
            .get(number as usize)
            .ok_or(format!("GPU {number} doesn't exist: the driver reports {known} GPUs"))?;
        let nvrtc = Nvrtc::find()?;
        let (architecture, format) = nvrtc.target(gpu.architecture)?;
        let file = cache::cache_folder()
            .map(|folder| folder.join(cache::file_name(&nvrtc, found.version, architecture, format)));
        let driver = driver()?;
        let (mut device, mut context) = (0, null_mut());
        // SAFETY: the device exists; its context is retained for the lifetime of the process.
        unsafe {
            driver.check((driver.cuDeviceGet)(&mut device, number))?;
            driver.check((driver.cuDevicePrimaryCtxRetain)(&mut context, device))?;
            driver.check((driver.cuCtxSetCurrent)(context))?;
        }
        let load = |image: &[u8]| {
            let mut module = null_mut();
            // SAFETY: the image is complete, and PTX is terminated with a 0.
            driver.check(unsafe { (driver.cuModuleLoadData)(&mut module, image.as_ptr().cast()) })?;
            Ok::<_, String>(module)
        };
        let kept = file.as_deref().and_then(cache::read).and_then(|image| load(&image).ok());
        let was_cached = kept.is_some();
        let (module, file) = match kept {
            Some(module) => (module, file),
            None => {
                let mut image = nvrtc.compile(architecture, format)?.image;
                let mut module = load(&image);
                // A driver older than NVRTC may refuse its machine code; the driver then compiles PTX itself.
                if module.is_err() && format == CodeFormat::Cubin {
                    image = nvrtc.compile(architecture, CodeFormat::Ptx)?.image;
                    module = load(&image);
                }
                (module?, file.filter(|file| cache::write(file, &image)))
            }
        };
        let kernels = HashMap::new();
        Ok((LoadedKernels { context, module, kernels }, KernelOrigin { architecture, file, was_cached }))
    }

    fn kernel(&mut self, driver: &DriverFunctions, name: &str) -> Result<Handle> {
        if let Some(&kernel) = self.kernels.get(name) {
            return Ok(kernel);
        }
        let terminated = CString::new(name).map_err(|e| e.to_string())?;
        let mut kernel = null_mut();
        // SAFETY: the module is loaded.
        driver
            .check(unsafe { (driver.cuModuleGetFunction)(&mut kernel, self.module, terminated.as_ptr()) })?;
        self.kernels.insert(name.into(), kernel);
        Ok(kernel)
    }
}

static DEVICES: LazyLock<Mutex<HashMap<i32, LoadedKernels>>> = LazyLock::new(Default::default);

/// Loads the kernels on the device with this index: from the cache, or compiled now.
///
/// # Errors
/// Returns an error if a library is missing, or if the compiler or the driver fails.
pub fn load_kernels(device: i32) -> Result<KernelOrigin> {
    let (loaded, origin) = LoadedKernels::load(device)?;
    DEVICES.lock().unwrap_or_else(PoisonError::into_inner).insert(device, loaded);
    Ok(origin)
}

/// Launches a kernel; see `launch_kernel` in the bridge.
///
/// # Safety
/// `stream` must be a stream of the device, and `arguments` must match the kernel's parameters in number and types.
pub unsafe fn launch_kernel(
    device: i32,
    stream: usize,
    kernel: &str,
    blocks: [u32; 2],
    threads_per_block: u32,
    arguments: usize,
) -> Result<()> {
    let mut devices = DEVICES.lock().unwrap_or_else(PoisonError::into_inner);
    let loaded = match devices.entry(device) {
        Entry::Occupied(known) => known.into_mut(),
        Entry::Vacant(place) => place.insert(LoadedKernels::load(device)?.0),
    };
    let driver = driver()?;
    let function = loaded.kernel(driver, kernel)?;
    let (shared_bytes, extra) = (0, null_mut());
    // SAFETY: guaranteed by the caller.
    let launched = driver.check(unsafe { (driver.cuCtxSetCurrent)(loaded.context) }).and_then(|()| {
        driver.check(unsafe {
            (driver.cuLaunchKernel)(
                function,
                blocks[0],
                blocks[1],
                1,
                threads_per_block,
                1,
                1,
                shared_bytes,
                stream as Handle,
                arguments as *mut Handle,
                extra,
            )
        })
    });
    launched.map_err(|error| format!("{kernel}: {error}"))
}
