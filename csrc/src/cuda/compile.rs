//! The kernels' text to machine code, by NVRTC.

use super::{Result, libraries::load_nvrtc};
use cudarc::nvrtc::{result::NvrtcError, sys};
use std::ffi::{CStr, CString, c_char, c_int};
use std::ptr;

/// The kernels, and what they include, by the names by which they do.
const TEXT: &str = include_str!("../../cuda/kernels.cu");
const HEADERS: &[(&str, &str)] = &[
    ("call.h", include_str!("../../cuda/call.h")),
    ("gaussians.h", include_str!("../../cuda/gaussians.h")),
    ("lane.h", include_str!("../../raster/lane.h")),
    ("lens.h", include_str!("../../raster/lens.h")),
    ("lists.h", include_str!("../../cuda/lists.h")),
    ("pixel.h", include_str!("../../raster/pixel.h")),
    ("project.h", include_str!("../../raster/project.h")),
    ("reach.h", include_str!("../../raster/reach.h")),
    ("sh.h", include_str!("../../raster/sh.h")),
    ("simd.h", include_str!("../../raster/simd.h")),
    ("sort.h", include_str!("../../cuda/sort.h")),
    ("tiles.h", include_str!("../../cuda/tiles.h")),
    ("types.h", include_str!("../../raster/types.h")),
    ("warp.h", include_str!("../../cuda/warp.h")),
    // Of the standard library NVRTC has the functions, but not the headers.
    ("cmath", ""),
    (
        "cstdint",
        "typedef signed char int8_t; typedef unsigned char uint8_t; typedef short int16_t; \
         typedef unsigned short uint16_t; typedef int int32_t; typedef unsigned int uint32_t; \
         typedef long int64_t; typedef unsigned long uint64_t;",
    ),
];

/// Nothing is fused that isn't written so, and nothing is rounded in another way than on a CPU: pictures have the CPU's bits.
const OPTIONS: &[&str] = &[
    "--std=c++17",
    "--device-as-default-execution-space",
    "--fmad=false",
    "--ftz=false",
    "--prec-div=true",
    "--prec-sqrt=true",
];

/// What NVRTC makes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// Machine code of one architecture.
    Cubin,
    /// What the driver turns into it, for that architecture or a newer one.
    Ptx,
}

/// What the driver loads.
#[derive(Debug)]
pub struct Compiled {
    /// A cubin, or PTX.
    pub image: Vec<u8>,
    /// What the compiler said of every kernel: registers, shared memory, spills.
    pub log: String,
}

/// The compiler that was found.
#[derive(Debug, Clone)]
pub struct Nvrtc {
    /// As in 13.0.
    pub version: (i32, i32),
    /// Compute capabilities that it compiles for, as in 90 for 9.0, in their order.
    pub architectures: Vec<i32>,
}

impl Nvrtc {
    /// Loads it.
    ///
    /// # Errors
    /// It isn't there, or isn't what it seems.
    pub fn find() -> Result<Self> {
        load_nvrtc()?;
        let (mut major, mut minor, mut count) = (0, 0, 0);
        // SAFETY: the library is there, and the second list has room for as many as it said.
        unsafe {
            told(sys::nvrtcVersion(&mut major, &mut minor).result())?;
            told(sys::nvrtcGetNumSupportedArchs(&mut count).result())?;
            let mut architectures = vec![0; count as usize];
            told(sys::nvrtcGetSupportedArchs(architectures.as_mut_ptr()).result())?;
            architectures.sort_unstable();
            Ok(Nvrtc { version: (major, minor), architectures })
        }
    }

    /// For a GPU of compute capability `of`, as in 90: for which architecture to compile, and to what.
    ///
    /// # Errors
    /// A GPU that is too old.
    pub fn target(&self, of: i32) -> Result<(i32, Form)> {
        let known = self.architectures.iter().rev().find(|&&known| known <= of);
        match known {
            Some(&known) if known == of => Ok((of, Form::Cubin)),
            Some(&known) => Ok((known, Form::Ptx)),
            None => Err(format!(
                "the GPU has compute capability {}.{}, expected {}.{} or more, the least that NVRTC {}.{} compiles for",
                of / 10,
                of % 10,
                self.architectures[0] / 10,
                self.architectures[0] % 10,
                self.version.0,
                self.version.1
            )),
        }
    }

    /// Compiles all kernels.
    ///
    /// # Errors
    /// What the compiler says.
    pub fn compile(&self, architecture: i32, form: Form) -> Result<Compiled> {
        let terminated = |text: &str| CString::new(text).expect("C++ holds no 0");
        let text = terminated(TEXT);
        let (names, headers): (Vec<CString>, Vec<CString>) =
            HEADERS.iter().map(|(name, header)| (terminated(name), terminated(header))).unzip();
        let addresses = |texts: &[CString]| texts.iter().map(|text| text.as_ptr()).collect::<Vec<_>>();
        let (name_addresses, header_addresses) = (addresses(&names), addresses(&headers));
        let options: Vec<CString> = options(architecture, form).iter().map(|o| terminated(o)).collect();

        let mut program = ptr::null_mut();
        // SAFETY: all texts are terminated, and live until the program is destroyed.
        unsafe {
            let created = sys::nvrtcCreateProgram(
                &mut program,
                text.as_ptr(),
                c"kernels.cu".as_ptr(),
                HEADERS.len() as c_int,
                header_addresses.as_ptr(),
                name_addresses.as_ptr(),
            );
            told(created.result())?;
            let compiled = compile_program(program, &addresses(&options), form);
            told(sys::nvrtcDestroyProgram(&mut program).result())?;
            compiled
        }
    }
}

/// # Safety
/// A program, and terminated texts.
unsafe fn compile_program(
    program: sys::nvrtcProgram,
    options: &[*const c_char],
    form: Form,
) -> Result<Compiled> {
    // SAFETY: the caller's promise; what is asked for has the size that was told.
    unsafe {
        let done = sys::nvrtcCompileProgram(program, options.len() as c_int, options.as_ptr());
        let log = filled(program, sys::nvrtcGetProgramLogSize, sys::nvrtcGetProgramLog)?;
        let log = CStr::from_bytes_until_nul(&log).unwrap_or_default().to_string_lossy().into_owned();
        if let Err(error) = done.result() {
            return Err(format!("NVRTC can't compile the kernels ({error}): {log}"));
        }
        let image = match form {
            Form::Cubin => filled(program, sys::nvrtcGetCUBINSize, sys::nvrtcGetCUBIN)?,
            Form::Ptx => filled(program, sys::nvrtcGetPTXSize, sys::nvrtcGetPTX)?,
        };
        Ok(Compiled { image, log })
    }
}

/// What NVRTC has of a program, by the two functions that tell its size and fill in that much.
///
/// # Safety
/// A program, and two functions that belong together.
unsafe fn filled(
    program: sys::nvrtcProgram,
    size: unsafe fn(sys::nvrtcProgram, *mut usize) -> sys::nvrtcResult,
    fill: unsafe fn(sys::nvrtcProgram, *mut c_char) -> sys::nvrtcResult,
) -> Result<Vec<u8>> {
    let mut bytes = 0;
    // SAFETY: the caller's promise.
    unsafe {
        told(size(program, &mut bytes).result())?;
        let mut out = vec![0; bytes];
        told(fill(program, out.as_mut_ptr().cast()).result())?;
        Ok(out)
    }
}

fn told(result: std::result::Result<(), NvrtcError>) -> Result<()> {
    result.map_err(|error| format!("NVRTC fails: {error}"))
}

fn options(architecture: i32, form: Form) -> Vec<String> {
    let kind = match form {
        Form::Cubin => "sm",
        Form::Ptx => "compute",
    };
    let mut options: Vec<String> = OPTIONS.iter().map(|option| option.to_string()).collect();
    options.push(format!("--gpu-architecture={kind}_{architecture}"));
    if form == Form::Cubin {
        options.push("--ptxas-options=-v".into());
    }
    options
}

/// All that goes into what is compiled, but for the compiler.
pub(super) fn everything(architecture: i32, form: Form) -> impl Iterator<Item = String> {
    let texts = HEADERS.iter().flat_map(|(name, header)| [name.to_string(), header.to_string()]);
    std::iter::once(TEXT.to_string()).chain(texts).chain(options(architecture, form))
}
