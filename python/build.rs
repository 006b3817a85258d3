//! Lets the linker of macOS leave the symbols of Python open, which the interpreter defines when it loads the module, and sets where the module
//! looks for libtorch there: in the torch beside this package.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    if std::env::var("CARGO_CFG_TARGET_OS").is_ok_and(|system| system == "macos") {
        println!("cargo::rustc-cdylib-link-arg=-undefined");
        println!("cargo::rustc-cdylib-link-arg=dynamic_lookup");
        println!("cargo::rustc-cdylib-link-arg=-Wl,-rpath,@loader_path/../torch/lib");
        // Otherwise its name is the path at which it was linked.
        println!("cargo::rustc-cdylib-link-arg=-Wl,-install_name,@rpath/_native.abi3.so");
    }
}
