//! Compilation of the kernels' source to machine code with NVRTC.

use super::{
    Result,
    libraries::{NvrtcFunctions, Program, nvrtc},
};
use std::ffi::{CStr, CString, c_char, c_int};
use std::ptr;

/// Source of the kernels. `HEADERS` are the files that it includes, by the names in its include directives.
const KERNEL_SOURCE: &str = include_str!("../../cuda/kernels.cu");
const HEADERS: &[(&str, &str)] = &[
    ("call.h", include_str!("../../cuda/call.h")),
    ("gaussians.h", include_str!("../../cuda/gaussians.h")),
    ("lane.h", include_str!("../../kernels/lane.h")),
    ("losses.h", include_str!("../../cuda/losses.h")),
    ("pixel.h", include_str!("../../kernels/pixel.h")),
    ("project.h", include_str!("../../kernels/project.h")),
    ("projection_params.h", include_str!("../../kernels/projection_params.h")),
    ("sh.h", include_str!("../../kernels/sh.h")),
    ("simd.h", include_str!("../../kernels/simd.h")),
    ("sort.h", include_str!("../../cuda/sort.h")),
    ("ssim_window.h", include_str!("../../kernels/ssim_window.h")),
    ("tile_lists.h", include_str!("../../cuda/tile_lists.h")),
    ("tiles.h", include_str!("../../cuda/tiles.h")),
    ("touched_cells.h", include_str!("../../kernels/touched_cells.h")),
    ("types.h", include_str!("../../kernels/types.h")),
    ("unevenness.h", include_str!("../../kernels/unevenness.h")),
    ("warp.h", include_str!("../../cuda/warp.h")),
    // NVRTC has the functions of the standard library built in, but not its headers.
    ("cmath", ""),
    (
        "cstdint",
        "typedef signed char int8_t; typedef unsigned char uint8_t; typedef short int16_t; \
         typedef unsigned short uint16_t; typedef int int32_t; typedef unsigned int uint32_t; \
         typedef long int64_t; typedef unsigned long uint64_t;",
    ),
];

/// Compiler options. They prevent fusing of operations unless the source asks for it, and rounding that differs from a CPU's: images are
/// bit-identical to the CPU's.
const OPTIONS: &[&str] = &[
    "--std=c++17",
    "--device-as-default-execution-space",
    "--fmad=false",
    "--ftz=false",
    "--prec-div=true",
    "--prec-sqrt=true",
];

/// Minimum compute capability that the kernels support, as in 75 for 7.5.
pub const MIN_ARCHITECTURE: i32 = 75;

/// Output format of NVRTC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CodeFormat {
    /// Machine code for one architecture.
    Cubin,
    /// Intermediate code that the driver compiles for that architecture or a newer one.
    Ptx,
}

/// Compiled kernels.
#[derive(Debug)]
pub struct Compiled {
    /// Image that the driver loads: a cubin, or PTX.
    pub image: Vec<u8>,
    /// Compiler log with the resources of every kernel: registers, shared memory, spills.
    pub log: String,
}

/// Installed NVRTC compiler.
#[derive(Debug, Clone)]
pub struct Nvrtc {
    /// Version as major and minor, as in 13.0.
    pub version: (i32, i32),
    /// Supported compute capabilities in ascending order, as in 90 for 9.0.
    pub architectures: Vec<i32>,
}

impl Nvrtc {
    /// Loads NVRTC and queries its properties.
    ///
    /// # Errors
    /// Returns an error if NVRTC is missing or a call fails.
    pub fn find() -> Result<Self> {
        let nvrtc = nvrtc()?;
        let (mut major, mut minor, mut count) = (0, 0, 0);
        // SAFETY: the list has as many elements as NVRTC reported.
        unsafe {
            nvrtc.check((nvrtc.nvrtcVersion)(&mut major, &mut minor))?;
            nvrtc.check((nvrtc.nvrtcGetNumSupportedArchs)(&mut count))?;
            let mut architectures = vec![0; count as usize];
            nvrtc.check((nvrtc.nvrtcGetSupportedArchs)(architectures.as_mut_ptr()))?;
            // Warps of older GPUs lack instructions that the kernels need.
            architectures.retain(|&of| of >= MIN_ARCHITECTURE);
            architectures.sort_unstable();
            Ok(Nvrtc { version: (major, minor), architectures })
        }
    }

    /// Returns the architecture and the format to compile for, given a GPU of compute capability `of`, as in 90.
    ///
    /// # Errors
    /// Returns an error if the GPU is too old.
    pub fn target(&self, of: i32) -> Result<(i32, CodeFormat)> {
        let known = self.architectures.iter().rev().find(|&&known| known <= of);
        match known {
            Some(&known) if known == of => Ok((of, CodeFormat::Cubin)),
            Some(&known) => Ok((known, CodeFormat::Ptx)),
            None => Err(format!(
                "the GPU has compute capability {}.{}, expected {}.{} or more",
                of / 10,
                of % 10,
                MIN_ARCHITECTURE / 10,
                MIN_ARCHITECTURE % 10
            )),
        }
    }

    /// Compiles all kernels.
    ///
    /// # Errors
    /// Returns the compiler's messages.
    pub fn compile(&self, architecture: i32, format: CodeFormat) -> Result<Compiled> {
        let terminated = |text: &str| CString::new(text).expect("C++ holds no 0");
        let text = terminated(KERNEL_SOURCE);
        let (names, headers): (Vec<CString>, Vec<CString>) =
            HEADERS.iter().map(|(name, header)| (terminated(name), terminated(header))).unzip();
        let addresses = |texts: &[CString]| texts.iter().map(|text| text.as_ptr()).collect::<Vec<_>>();
        let (name_addresses, header_addresses) = (addresses(&names), addresses(&headers));
        let options: Vec<CString> = options(architecture, format).iter().map(|o| terminated(o)).collect();

        let nvrtc = nvrtc()?;
        let mut program = ptr::null_mut();
        // SAFETY: all strings are null-terminated and live until the program is destroyed.
        unsafe {
            nvrtc.check((nvrtc.nvrtcCreateProgram)(
                &mut program,
                text.as_ptr(),
                c"kernels.cu".as_ptr(),
                HEADERS.len() as c_int,
                header_addresses.as_ptr(),
                name_addresses.as_ptr(),
            ))?;
            let compiled = nvrtc.compile(program, &addresses(&options), format);
            nvrtc.check((nvrtc.nvrtcDestroyProgram)(&mut program))?;
            compiled
        }
    }
}

impl NvrtcFunctions {
    /// Compiles a program and returns the result and the log.
    ///
    /// # Safety
    /// `program` must be a valid program, and `options` null-terminated strings.
    unsafe fn compile(
        &self,
        program: Program,
        options: &[*const c_char],
        format: CodeFormat,
    ) -> Result<Compiled> {
        // SAFETY: the caller's promise; output buffers have the size that NVRTC reported.
        unsafe {
            let done = (self.nvrtcCompileProgram)(program, options.len() as c_int, options.as_ptr());
            let log = self.read_output(program, self.nvrtcGetProgramLogSize, self.nvrtcGetProgramLog)?;
            let log = CStr::from_bytes_until_nul(&log).unwrap_or_default().to_string_lossy().into_owned();
            if let Err(error) = self.check(done) {
                return Err(format!("{error}: {log}"));
            }
            let image = match format {
                CodeFormat::Cubin => self.read_output(program, self.nvrtcGetCUBINSize, self.nvrtcGetCUBIN)?,
                CodeFormat::Ptx => self.read_output(program, self.nvrtcGetPTXSize, self.nvrtcGetPTX)?,
            };
            Ok(Compiled { image, log })
        }
    }

    /// Reads an output of a program, given the function that returns its size and the one that fills a buffer of that size.
    ///
    /// # Safety
    /// `program` must be a valid program, and the two functions must belong together.
    unsafe fn read_output(
        &self,
        program: Program,
        size: unsafe extern "C" fn(Program, *mut usize) -> c_int,
        fill: unsafe extern "C" fn(Program, *mut c_char) -> c_int,
    ) -> Result<Vec<u8>> {
        let mut bytes = 0;
        // SAFETY: the caller's promise.
        unsafe {
            self.check(size(program, &mut bytes))?;
            let mut out = vec![0; bytes];
            self.check(fill(program, out.as_mut_ptr().cast()))?;
            Ok(out)
        }
    }

    /// Converts a result code of NVRTC to a `Result`.
    fn check(&self, result: c_int) -> Result<()> {
        if result == 0 {
            return Ok(());
        }
        // SAFETY: the function returns a string for any number.
        let words = unsafe { CStr::from_ptr((self.nvrtcGetErrorString)(result)) };
        Err(format!("NVRTC can't compile the kernels: {}", words.to_string_lossy()))
    }
}

fn options(architecture: i32, format: CodeFormat) -> Vec<String> {
    let kind = match format {
        CodeFormat::Cubin => "sm",
        CodeFormat::Ptx => "compute",
    };
    let mut options: Vec<String> = OPTIONS.iter().map(|option| option.to_string()).collect();
    options.push(format!("--gpu-architecture={kind}_{architecture}"));
    if format == CodeFormat::Cubin {
        options.push("--ptxas-options=-v".into());
    }
    options
}

/// Returns everything that the output depends on except the compiler: sources, headers and options.
pub(super) fn compile_inputs(architecture: i32, format: CodeFormat) -> impl Iterator<Item = String> {
    let texts = HEADERS.iter().flat_map(|(name, header)| [name.to_string(), header.to_string()]);
    std::iter::once(KERNEL_SOURCE.to_string()).chain(texts).chain(options(architecture, format))
}
