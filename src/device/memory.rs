//! Memory use of the process and of its tensors on a GPU.

use crate::render::cuda::Driver;
use globalsplat_csrc::runtime as ffi;
use std::path::{Path, PathBuf};
use tch::Device;

/// Returns the current resident memory of the process in bytes, or its peak on systems that don't report the current value.
pub fn resident_memory_bytes() -> u64 {
    let from_linux = || -> Option<u64> {
        let pages: u64 = std::fs::read_to_string("/proc/self/statm").ok()?.split(' ').nth(1)?.parse().ok()?;
        // SAFETY: `sysconf` only returns a number.
        let page_size = unsafe { libc::sysconf(libc::_SC_PAGESIZE) };
        Some(pages * u64::try_from(page_size).ok()?)
    };
    from_linux().unwrap_or_else(peak_memory_bytes)
}

/// Returns the peak memory of the tensors on `device` in bytes, since the start of the program or the last [`reset_peak_memory`]. Returns
/// `None` for the CPU.
pub fn peak_device_memory_bytes(device: Device) -> Option<u64> {
    match device {
        Device::Cuda(number) => ffi::max_memory_allocated(number as i32).ok(),
        _ => None,
    }
}

/// Returns the total memory of `device` in bytes. For the CPU, this is the memory of the machine or the limit of the process's control
/// group, whichever is lower. Returns `None` if it is unknown.
pub fn total_memory_bytes(device: Device) -> Option<u64> {
    match device {
        Device::Cuda(number) => Driver::find().ok()?.gpus.get(number).map(|gpu| gpu.memory as u64),
        _ => {
            // SAFETY: `sysconf` only returns numbers.
            let [pages, page_size] = [libc::_SC_PHYS_PAGES, libc::_SC_PAGESIZE]
                .map(|name| u64::try_from(unsafe { libc::sysconf(name) }).ok());
            let physical = pages? * page_size?;
            Some(cgroup_limits().fold(physical, u64::min))
        }
    }
}

/// Returns the memory limits of the process's control group and of its ancestors, in bytes (cgroups(7), version 2).
fn cgroup_limits() -> impl Iterator<Item = u64> {
    let groups = std::fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let group = groups.lines().find_map(|line| line.strip_prefix("0::/")).unwrap_or_default().to_string();
    let folders: Vec<PathBuf> =
        Path::new("/sys/fs/cgroup").join(group).ancestors().map(PathBuf::from).collect();
    let limit =
        |folder: PathBuf| std::fs::read_to_string(folder.join("memory.max")).ok()?.trim().parse().ok();
    folders.into_iter().filter_map(limit)
}

/// Returns the peak memory of work on `device` in bytes: of the GPU's tensors for a GPU, of the process for the CPU.
pub fn peak_memory_bytes_on(device: Device) -> u64 {
    peak_device_memory_bytes(device).unwrap_or_else(peak_memory_bytes)
}

/// Resets the peak memory of the process and of `device` to the current use. The peak of the process can be reset only on Linux.
pub fn reset_peak_memory(device: Device) {
    // Writing 5 resets the peak resident memory (proc(5)). If this isn't supported, the old peak remains.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
    if let Device::Cuda(number) = device {
        let _ = ffi::reset_peak_memory_stats(number as i32);
    }
}

/// Returns the peak resident memory of the process so far, in bytes.
pub fn peak_memory_bytes() -> u64 {
    // On Linux, getrusage also counts the memory that the parent process had before this program replaced its copy.
    peak_from_status(&std::fs::read_to_string("/proc/self/status").unwrap_or_default())
        .unwrap_or_else(peak_from_usage)
}

/// Returns the peak resident memory in bytes from the contents of `/proc/PID/status` (proc(5)).
fn peak_from_status(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(1024 * kibibytes)
}

fn peak_from_usage() -> u64 {
    // SAFETY: `rusage` consists of plain numbers, for which zero is valid, and `getrusage` only writes into it.
    let usage = unsafe {
        let mut usage: libc::rusage = std::mem::zeroed();
        libc::getrusage(libc::RUSAGE_SELF, &mut usage);
        usage
    };
    // Linux reports KiB, and macOS reports bytes.
    let unit = if cfg!(target_os = "macos") { 1 } else { 1024 };
    usage.ru_maxrss as u64 * unit
}
