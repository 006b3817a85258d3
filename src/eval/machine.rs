//! Description of the machine that results were measured on.

use crate::error::Result;
use crate::render::cpu::simd_level;
use tch::Device;

/// Returns the processor, its number of cores, the SIMD level, and the device unless it is the CPU, such as
/// `Intel(R) Xeon(R), 2 cores, avx512`.
///
/// # Errors
/// Fails if `GLOBALSPLAT_SIMD` names a SIMD level that this machine doesn't have.
pub fn machine(device: Device) -> Result<String> {
    let cpu_info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model_name = cpu_info.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    let processor = model_name.map_or(std::env::consts::ARCH, |(_, name)| name.trim());
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let gpu = match device {
        Device::Cpu => String::new(),
        other => format!(", {other:?}"),
    };
    Ok(format!("{processor}, {cores} cores, {}{gpu}", simd_level()?))
}
