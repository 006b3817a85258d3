//! Sets the rpath with which the binary, tests and examples find libtorch, which `GLOBALSPLAT_RPATH` overrides for a program that is moved,
//! and embeds the viewer of the HTML pages in the binary.

use std::env;
use std::fs;
use std::path::Path;

fn main() {
    let lib = env::var("DEP_GLOBALSPLAT_LIBTORCH_LIB").expect("globalsplat-csrc tells where libtorch is");
    let lib = env::var("GLOBALSPLAT_RPATH").unwrap_or(lib);
    println!("cargo::rustc-link-arg=-Wl,-rpath,{lib}");
    println!("cargo::rerun-if-env-changed=GLOBALSPLAT_RPATH");
    println!("cargo::rerun-if-changed=build.rs");

    // Bundle that scripts/setup.sh builds if npm is available.
    let bundle = Path::new("web/dist/page.js");
    // Cargo treats a missing file as changed on every build.
    let watched = if bundle.exists() { bundle } else { Path::new("web") };
    println!("cargo::rerun-if-changed={}", watched.display());
    let out = env::var_os("OUT_DIR").expect("cargo names it");
    let viewer = fs::read(bundle).unwrap_or_default();
    fs::write(Path::new(&out).join("page.js"), viewer).expect("a folder that can be written to");
}
