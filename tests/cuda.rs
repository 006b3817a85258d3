//! The kernels for GPUs, as far as a machine without one can tell.

mod common;

use common::skip;
use globalsplat::render::cuda::{Form, Nvrtc, usage};

/// The oldest and the newest that are promised.
const OLDEST: i32 = 75;
const NEWEST: i32 = 120;
/// Bytes that every GPU's blocks may share, and threads of the largest block times their registers.
const SHARED: u32 = 48 << 10;
const REGISTERS: u32 = 64 << 10;
const BLOCK: u32 = 256;

fn nvrtc() -> Option<Nvrtc> {
    Nvrtc::find().map_err(|why| skip("NVRTC", &why)).ok()
}

#[test]
fn kernels_compile_for_every_gpu_and_need_no_memory_for_registers() {
    let Some(nvrtc) = nvrtc() else { return };
    let promised: Vec<i32> =
        nvrtc.architectures.iter().copied().filter(|of| (OLDEST..=NEWEST).contains(of)).collect();
    assert!(promised.contains(&OLDEST) && promised.contains(&NEWEST), "{promised:?}");
    for architecture in promised {
        let compiled = nvrtc.compile(architecture, Form::Cubin).unwrap();
        assert!(compiled.image.starts_with(b"\x7fELF"), "{architecture}");
        let kernels = usage(&compiled.log);
        assert_eq!(kernels.len(), 11, "{}", compiled.log);
        for kernel in kernels {
            assert!(kernel.spills == 0 && kernel.shared <= SHARED, "{architecture}: {kernel:?}");
            // Those of 128 threads may have all that there are.
            let threads = if kernel.name.contains("project") { BLOCK / 2 } else { BLOCK };
            assert!(
                kernel.registers > 0 && kernel.registers * threads <= REGISTERS,
                "{architecture}: {kernel:?}"
            );
        }
    }
}

#[test]
fn newer_gpus_get_what_their_driver_compiles_and_older_ones_a_sentence() {
    let Some(nvrtc) = nvrtc() else { return };
    let newest = *nvrtc.architectures.last().unwrap();
    assert_eq!(nvrtc.target(newest), Ok((newest, Form::Cubin)));
    assert_eq!(nvrtc.target(newest + 10), Ok((newest, Form::Ptx)));
    let ptx = nvrtc.compile(newest, Form::Ptx).unwrap().image;
    assert!(ptx.ends_with(&[0]) && String::from_utf8_lossy(&ptx).contains(".entry gs_blend"));
    let refused = nvrtc.target(nvrtc.architectures[0] - 1).unwrap_err();
    assert!(refused.contains("compute capability") && refused.contains("expected"), "{refused}");
}
