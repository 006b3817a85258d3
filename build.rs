//! Lets the binary, tests and examples find libtorch again by rpath, and the binary the viewer that its pages have.

use std::env;
use std::fs;
use std::path::Path;

fn main() {
    let lib = env::var("DEP_GLOBALSPLAT_LIBTORCH_LIB").expect("globalsplat-csrc tells where libtorch is");
    println!("cargo::rustc-link-arg=-Wl,-rpath,{lib}");
    println!("cargo::rerun-if-changed=build.rs");

    // What scripts/setup.sh bundles where there is npm.
    let bundle = Path::new("web/dist/page.js");
    // What isn't there counts as changed, every time.
    let watched = if bundle.exists() { bundle } else { Path::new("web") };
    println!("cargo::rerun-if-changed={}", watched.display());
    let out = env::var_os("OUT_DIR").expect("cargo names it");
    let viewer = fs::read(bundle).unwrap_or_default();
    fs::write(Path::new(&out).join("page.js"), viewer).expect("a folder that can be written to");
}
