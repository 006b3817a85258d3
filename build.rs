//! Lets the binary, tests and examples find libtorch again by rpath.

use std::env;

fn main() {
    let lib = env::var("DEP_GLOBALSPLAT_LIBTORCH_LIB").expect("globalsplat-csrc tells where libtorch is");
    println!("cargo::rustc-link-arg=-Wl,-rpath,{lib}");
    println!("cargo::rerun-if-changed=build.rs");
}
