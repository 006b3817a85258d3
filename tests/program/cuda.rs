//! GPU kernels, as far as they can be tested without a GPU.

use crate::common::{rerun_test, skip};
use globalsplat::render::cuda::{CodeFormat, Driver, Nvrtc, cache_folder, load_kernels};
use std::path::Path;
use std::process::Command;

/// Supported GPU architectures, from the oldest to the newest. Variants for embedded systems are left out.
const ARCHITECTURES: [i32; 7] = [75, 80, 86, 89, 90, 100, 120];

fn nvrtc() -> Option<Nvrtc> {
    Nvrtc::find().map_err(|why| skip("NVRTC", &why)).ok()
}

#[test]
fn kernels_compile_for_every_gpu_and_need_no_memory_for_registers() {
    let Some(nvrtc) = nvrtc() else { return };
    for architecture in ARCHITECTURES {
        let compiled = nvrtc.compile(architecture, CodeFormat::Cubin).unwrap();
        assert!(compiled.image.starts_with(b"\x7fELF"), "{architecture}");
        // Shared memory and registers are within the limits of every GPU, or ptxas fails: blocks have at most 48 KiB, and every kernel has
        // launch bounds or blocks so small that 255 registers per thread are available.
        println!("{}", compiled.log);
        let lines = |text: &str| compiled.log.lines().filter(|line| line.contains(text)).count();
        assert_eq!(lines("entry function 'gs_"), 12, "{}", compiled.log);
        assert_eq!(lines("bytes spill stores"), lines(" 0 bytes spill stores, 0 bytes spill loads"));
        assert!(lines("bytes spill stores") >= 12, "{}", compiled.log);
    }
}

#[test]
fn newer_gpus_get_ptx_and_older_ones_are_refused() {
    let Some(nvrtc) = nvrtc() else { return };
    let newest = *nvrtc.architectures.last().unwrap();
    assert_eq!(nvrtc.target(newest), Ok((newest, CodeFormat::Cubin)));
    assert_eq!(nvrtc.target(newest + 10), Ok((newest, CodeFormat::Ptx)));
    let ptx = nvrtc.compile(newest, CodeFormat::Ptx).unwrap().image;
    assert!(ptx.ends_with(&[0]));
    // A splat's sums over a warp take eleven shuffles.
    let ptx = String::from_utf8_lossy(&ptx);
    let kernel = ptx.split(".entry ").find(|text| text.starts_with("gs_blend_backward")).expect("a kernel");
    assert_eq!(kernel.matches("shfl.sync.bfly").count(), 11);
    let refused = nvrtc.target(nvrtc.architectures[0] - 1).unwrap_err();
    assert!(refused.contains("compute capability") && refused.contains("expected"), "{refused}");
}

/// Returns a folder with a fake driver, which loaders find by LD_LIBRARY_PATH. Beside it is a toolkit's stub, which only
/// linkers use.
fn fake_driver() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let stub = folder.path().join("stub.c");
    std::fs::write(&stub, "int cuInit(unsigned flags) { return 34; }").expect("a file");
    let compiler = std::env::var("CXX").unwrap_or("c++".into());
    for (source, library) in
        [(Path::new("tests/common/fake_driver.c"), "libcuda.so.1"), (&stub, "libcuda.so")]
    {
        let compiled = Command::new(&compiler)
            .args(["-x", "c", "-shared", "-fPIC", "-o"])
            .args([&folder.path().join(library), source])
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .status()
            .expect("the compiler that this was built with");
        assert!(compiled.success());
    }
    folder
}

#[test]
fn kernels_are_compiled_once() {
    if nvrtc().is_none() {
        return;
    }
    // The driver is looked up once per process: this test runs itself again with a fake one.
    const EXPECTED: &str = "GLOBALSPLAT_TEST_EXPECTED";
    if let Some(expected) = std::env::var_os(EXPECTED) {
        let driver = Driver::find().unwrap();
        let gpu = &driver.gpus[0];
        assert_eq!((driver.version, gpu.name.as_str(), gpu.architecture), (13000, "Imaginary", 90));
        assert_eq!((gpu.memory, gpu.multiprocessors), (8 << 30, 132));
        let origin = load_kernels(0).unwrap();
        assert_eq!((origin.architecture, origin.was_cached), (90, expected == "kept"));
        let file = origin.file.expect("a place for it");
        assert!(file.starts_with(cache_folder().unwrap()) && file.is_file());
        assert!(load_kernels(1).unwrap_err().contains("1 GPUs"));
        return;
    }
    let (driver, cache) = (fake_driver(), tempfile::tempdir().expect("a temporary folder"));
    let run = |expected: &str| {
        let variables = [
            ("LD_LIBRARY_PATH", driver.path()),
            ("XDG_CACHE_HOME", cache.path()),
            (EXPECTED, Path::new(expected)),
        ];
        assert!(rerun_test("cuda::kernels_are_compiled_once", &variables).0, "{expected}");
    };
    run("compiled");
    run("kept");
}

#[cfg(target_os = "linux")]
#[test]
fn doctor_reports_missing_libraries() {
    use crate::common::program::run_process;
    let driver = fake_driver();
    let doctor = |error: &str| {
        let mut doctor = Command::new(env!("CARGO_BIN_EXE_globalsplat"));
        doctor.arg("doctor").env("GLOBALSPLAT_FAKE_DRIVER", error);
        doctor.envs([("LD_LIBRARY_PATH", driver.path()), ("XDG_CACHE_HOME", driver.path())]);
        run_process(&mut doctor).0
    };
    let found = doctor("");
    assert!(
        found.contains("Imaginary") && found.contains("compute_capability 9.0") && found.contains("13.0"),
        "{found}"
    );
    assert!(found.contains("this libtorch can't use it"), "{found}");
    assert!(doctor("no device").contains("the driver reports none"));
    assert!(doctor("mismatch").contains("unsupported display driver"));
}
