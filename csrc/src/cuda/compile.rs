//! The kernels' text to machine code, by NVRTC.

use super::{
    Result,
    libraries::{NvrtcFunctions, Program, nvrtc},
};
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
    ("losses.h", include_str!("../../cuda/losses.h")),
    ("neighbours.h", include_str!("../../raster/neighbours.h")),
    ("pixel.h", include_str!("../../raster/pixel.h")),
    ("project.h", include_str!("../../raster/project.h")),
    ("reach.h", include_str!("../../raster/reach.h")),
    ("sh.h", include_str!("../../raster/sh.h")),
    ("simd.h", include_str!("../../raster/simd.h")),
    ("sort.h", include_str!("../../cuda/sort.h")),
    ("tiles.h", include_str!("../../cuda/tiles.h")),
    ("types.h", include_str!("../../raster/types.h")),
    ("warp.h", include_str!("../../cuda/warp.h")),
    ("window.h", include_str!("../../raster/window.h")),
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

/// The least compute capability that the kernels are for, as in 75 for 7.5.
pub const OLDEST: i32 = 75;

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
        let nvrtc = nvrtc()?;
        let (mut major, mut minor, mut count) = (0, 0, 0);
        // SAFETY: the list has room for as many as were told.
        unsafe {
            nvrtc.told((nvrtc.nvrtcVersion)(&mut major, &mut minor))?;
            nvrtc.told((nvrtc.nvrtcGetNumSupportedArchs)(&mut count))?;
            let mut architectures = vec![0; count as usize];
            nvrtc.told((nvrtc.nvrtcGetSupportedArchs)(architectures.as_mut_ptr()))?;
            // Warps of older GPUs can't do what the kernels ask of them.
            architectures.retain(|&of| of >= OLDEST);
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
                "the GPU has compute capability {}.{}, expected {}.{} or more",
                of / 10,
                of % 10,
                OLDEST / 10,
                OLDEST % 10
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

        let nvrtc = nvrtc()?;
        let mut program = ptr::null_mut();
        // SAFETY: all texts are terminated, and live until the program is destroyed.
        unsafe {
            nvrtc.told((nvrtc.nvrtcCreateProgram)(
                &mut program,
                text.as_ptr(),
                c"kernels.cu".as_ptr(),
                HEADERS.len() as c_int,
                header_addresses.as_ptr(),
                name_addresses.as_ptr(),
            ))?;
            let compiled = nvrtc.compile(program, &addresses(&options), form);
            nvrtc.told((nvrtc.nvrtcDestroyProgram)(&mut program))?;
            compiled
        }
    }
}

impl NvrtcFunctions {
    /// # Safety
    /// A program, and terminated texts.
    unsafe fn compile(&self, program: Program, options: &[*const c_char], form: Form) -> Result<Compiled> {
        // SAFETY: the caller's promise; what is asked for has the size that was told.
        unsafe {
            let done = (self.nvrtcCompileProgram)(program, options.len() as c_int, options.as_ptr());
            let log = self.filled(program, self.nvrtcGetProgramLogSize, self.nvrtcGetProgramLog)?;
            let log = CStr::from_bytes_until_nul(&log).unwrap_or_default().to_string_lossy().into_owned();
            if let Err(error) = self.told(done) {
                return Err(format!("{error}: {log}"));
            }
            let image = match form {
                Form::Cubin => self.filled(program, self.nvrtcGetCUBINSize, self.nvrtcGetCUBIN)?,
                Form::Ptx => self.filled(program, self.nvrtcGetPTXSize, self.nvrtcGetPTX)?,
            };
            Ok(Compiled { image, log })
        }
    }

    /// What NVRTC has of a program, by the two functions that tell its size and fill in that much.
    ///
    /// # Safety
    /// A program, and two functions that belong together.
    unsafe fn filled(
        &self,
        program: Program,
        size: unsafe extern "C" fn(Program, *mut usize) -> c_int,
        fill: unsafe extern "C" fn(Program, *mut c_char) -> c_int,
    ) -> Result<Vec<u8>> {
        let mut bytes = 0;
        // SAFETY: the caller's promise.
        unsafe {
            self.told(size(program, &mut bytes))?;
            let mut out = vec![0; bytes];
            self.told(fill(program, out.as_mut_ptr().cast()))?;
            Ok(out)
        }
    }

    /// What a function's result means.
    fn told(&self, result: c_int) -> Result<()> {
        if result == 0 {
            return Ok(());
        }
        // SAFETY: it gives a text for any number.
        let words = unsafe { CStr::from_ptr((self.nvrtcGetErrorString)(result)) };
        Err(format!("NVRTC can't compile the kernels: {}", words.to_string_lossy()))
    }
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
