//! Compiles the C++ in this folder against the libtorch that `LIBTORCH` names, and links libtorch.

use std::{
    env, fs,
    path::{Path, PathBuf},
};

/// Source files with the cxx bridges between Rust and C++.
const BRIDGES: [&str; 5] =
    ["src/cuda.rs", "src/distributed.rs", "src/render.rs", "src/runtime.rs", "src/tensor_ops.rs"];

/// Returns the compiler settings that all C++ files share.
fn cpp() -> cc::Build {
    let mut build = cc::Build::new();
    build
        .cpp(true)
        .std("c++17")
        .opt_level(3)
        .warnings(true)
        .flag_if_supported("-fno-math-errno")
        .include(".");
    build
}

/// Compiles the rasterizer's kernels for one instruction set; every compiler for that target supports all `flags`.
fn kernels(isa: &str, flags: &[&str]) {
    let mut build = cpp();
    // GCC 12 warns of undefined values in its own AVX-512 headers.
    build.flag_if_supported("-Wno-maybe-uninitialized");
    build.define("GS_ISA", isa).flag("-ffp-contract=off").file("kernels/kernels_isa.cpp");
    for flag in flags {
        build.flag(flag);
    }
    build.compile(&format!("globalsplat_kernels_{isa}"));
}

/// Returns the folder of libtorch.
fn libtorch() -> PathBuf {
    println!("cargo::rerun-if-env-changed=LIBTORCH");
    let folder = PathBuf::from(env::var_os("LIBTORCH").unwrap_or_default());
    if !folder.join("include/ATen").is_dir() {
        let folder = folder.display();
        println!(
            "cargo::error=there is no libtorch in LIBTORCH={folder}; `make setup` puts one in .venv/libtorch"
        );
        std::process::exit(1);
    }
    folder.canonicalize().expect("it was there a moment ago")
}

/// Returns the include folders of NVIDIA's wheels, which lie beside that of torch.
fn nvidia(libtorch: &Path) -> Vec<PathBuf> {
    let wheels = fs::read_dir(libtorch.join("../nvidia")).into_iter().flatten();
    let mut folders: Vec<_> = wheels.flatten().map(|wheel| wheel.path().join("include")).collect();
    folders.retain(|folder| folder.is_dir());
    folders.sort();
    folders
}

/// Returns `true` if Clippy runs this script. Cargo keeps Clippy's build outputs apart from those of other commands, so the C++
/// would be compiled a second time for a check that links nothing.
fn is_clippy() -> bool {
    let wrapper = env::var_os("RUSTC_WORKSPACE_WRAPPER").unwrap_or_default();
    Path::new(&wrapper).file_stem().is_some_and(|name| name == "clippy-driver")
}

fn main() {
    let libtorch = libtorch();
    println!("cargo::metadata=libtorch_lib={}", libtorch.join("lib").display());
    if is_clippy() {
        return;
    }
    let include = libtorch.join("include").into_os_string().into_string().expect("an UTF-8 path");
    let mut torch = cxx_build::bridges(BRIDGES);
    // Headers of CUDA and NCCL, if libtorch's wheel came with them.
    for folder in nvidia(&libtorch) {
        torch.flag("-isystem").flag(folder);
    }
    if env::var("CARGO_CFG_TARGET_OS").is_ok_and(|system| system == "macos") {
        // libtorch's symbols are those of Clang 17 or older, and newer ones name some templates in another way.
        torch.flag_if_supported("-fclang-abi-compat=17");
    }
    torch
        .std("c++17")
        // libtorch is compiled with NDEBUG: without it some of its classes have more fields here than there.
        .define("NDEBUG", None)
        // The heavy work is done in kernels/ and in libtorch.
        .opt_level(1)
        .flag("-isystem")
        .flag(&include)
        .flag("-isystem")
        .flag(format!("{include}/torch/csrc/api/include"))
        .includes([".", "kernels"])
        .file("torch.cpp")
        .compile("globalsplat_torch");

    cpp()
        .files([
            "kernels/raster.cpp",
            "kernels/multi_head_attention.cpp",
            "kernels/depth_search.cpp",
            "kernels/image_losses.cpp",
            "kernels/optim.cpp",
            "kernels/parallel.cpp",
            "kernels/kernels.cpp",
        ])
        .compile("globalsplat_raster");
    // GPU kernels give bit-identical results to the CPU, so no multiply-add is fused here either unless written so.
    cpp()
        .includes(["kernels", "cuda"])
        .flag("-ffp-contract=off")
        .files(["cuda/frame.cpp", "cuda/emulator.cpp", "cuda/emulated_kernels.cpp"])
        .compile("globalsplat_cuda");
    match env::var("CARGO_CFG_TARGET_ARCH").as_deref() {
        Ok("x86_64") => {
            kernels("avx512", &["-mavx512f", "-mavx512dq", "-mavx512vl", "-mavx512bw", "-mfma"]);
            kernels("avx2", &["-mavx2", "-mfma"]);
            kernels("portable", &[]);
        }
        Ok("aarch64") => kernels("neon", &[]),
        _ => kernels("portable", &[]),
    }

    // libtorch must follow our own libraries, which need it, because linkers drop libraries that nothing has referenced yet.
    let lib = libtorch.join("lib");
    println!("cargo::rustc-link-search=native={}", lib.display());
    for library in ["torch_cpu", "c10", "torch"] {
        println!("cargo::rustc-link-lib={library}");
    }
    for entry in fs::read_dir(".").expect("this folder is there") {
        let path = entry.expect("it can be listed").path();
        if path.extension().is_none_or(|ending| ending != "md" && ending != "o") {
            println!("cargo::rerun-if-changed={}", path.display());
        }
    }
}
