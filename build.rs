//! Compiles the C++ in `csrc/` against the libtorch that torch-sys found, and lets the binary find it again by rpath.

use std::{env, path::Path};

/// What every C++ file is compiled with.
fn cpp() -> cc::Build {
    let mut build = cc::Build::new();
    build
        .cpp(true)
        .std("c++17")
        .opt_level(3)
        .warnings(true)
        .flag_if_supported("-fno-math-errno")
        .include("csrc");
    build
}

/// The rasterizer's kernels, once per instruction set; `flags` are all supported by any compiler for that target.
fn kernels(isa: &str, flags: &[&str]) {
    let mut build = cpp();
    // GCC 12 takes the undefined values in its own AVX-512 headers for mistakes.
    build.flag_if_supported("-Wno-maybe-uninitialized");
    build.define("GS_ISA", isa).flag("-ffp-contract=off").file("csrc/raster/kernels_isa.cpp");
    for flag in flags {
        build.flag(flag);
    }
    build.compile(&format!("globalsplat_kernels_{isa}"));
}

fn main() {
    let torch_lib = env::var("DEP_TCH_LIBTORCH_LIB").expect("torch-sys tells where libtorch is");
    let torch_include = Path::new(&torch_lib).parent().expect("libtorch/lib has a parent").join("include");

    cxx_build::bridges(["src/render/bridge.rs", "src/data/chunk/bridge.rs"])
        .std("c++17")
        .opt_level(2)
        .flag("-isystem")
        .flag(torch_include.to_str().expect("an UTF-8 path"))
        .flag("-isystem")
        .flag(torch_include.join("torch/csrc/api/include").to_str().expect("an UTF-8 path"))
        .include("csrc")
        .files(["csrc/splat.cpp", "csrc/projection.cpp", "csrc/marshal.cpp", "csrc/chunk.cpp"])
        .compile("globalsplat_torch");

    cpp()
        .files(["csrc/raster/raster.cpp", "csrc/raster/parallel.cpp", "csrc/raster/kernels.cpp"])
        .compile("globalsplat_raster");
    match env::var("CARGO_CFG_TARGET_ARCH").as_deref() {
        Ok("x86_64") => {
            kernels("avx512", &["-mavx512f", "-mavx512dq", "-mavx512vl", "-mavx512bw", "-mfma"]);
            kernels("avx2", &["-mavx2", "-mfma"]);
            kernels("portable", &[]);
        }
        Ok("aarch64") => kernels("neon", &[]),
        _ => kernels("portable", &[]),
    }

    let torch_lib = Path::new(&torch_lib).canonicalize().expect("libtorch's lib folder exists");
    println!("cargo:rustc-link-arg=-Wl,-rpath,{}", torch_lib.display());
    println!("cargo:rerun-if-changed=csrc");
    println!("cargo:rerun-if-changed=src/render/bridge.rs");
    println!("cargo:rerun-if-changed=src/data/chunk/bridge.rs");
}
