//! How much memory the process has taken.

use std::process::Command;
use tch::Device;

/// The resident size now, in bytes; where the system doesn't tell, the largest so far.
pub fn resident_memory_bytes() -> u64 {
    let from_linux = || -> Option<u64> {
        let pages: u64 = std::fs::read_to_string("/proc/self/statm").ok()?.split(' ').nth(1)?.parse().ok()?;
        // SAFETY: sysconf only tells a number.
        let page = unsafe { libc::sysconf(libc::_SC_PAGESIZE) };
        Some(pages * u64::try_from(page).ok()?)
    };
    from_linux().unwrap_or_else(peak_memory_bytes)
}

/// The memory of `device` that this process holds, in bytes; none for the CPU, and where `nvidia-smi` doesn't tell. libtorch keeps
/// what it once took, so it is also the largest amount so far.
pub fn device_memory_bytes(device: Device) -> Option<u64> {
    if !matches!(device, Device::Cuda(_)) {
        return None;
    }
    let query = ["--query-compute-apps=pid,used_gpu_memory", "--format=csv,noheader,nounits"];
    let told = Command::new("nvidia-smi").args(query).output().ok()?;
    of_process(&String::from_utf8_lossy(&told.stdout), std::process::id())
}

/// From lines of a process's number and its MiB.
fn of_process(table: &str, process: u32) -> Option<u64> {
    table.lines().find_map(|line| {
        let (pid, mebibytes) = line.split_once(',')?;
        (pid.trim().parse() == Ok(process)).then(|| Some(mebibytes.trim().parse::<u64>().ok()? << 20))?
    })
}

/// Forgets the largest resident size so far: [`peak_memory_bytes`] is of what comes from now on. Only Linux can.
pub fn forget_peak_memory() {
    // Where it can't be, the peak stays what it was.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// The largest resident size so far, in bytes.
pub fn peak_memory_bytes() -> u64 {
    // SAFETY: rusage is plain numbers, for which zero is valid, and getrusage only writes into it.
    let usage = unsafe {
        let mut usage: libc::rusage = std::mem::zeroed();
        libc::getrusage(libc::RUSAGE_SELF, &mut usage);
        usage
    };
    // Linux counts kibibytes, macOS bytes.
    let unit = if cfg!(target_os = "macos") { 1 } else { 1024 };
    usage.ru_maxrss as u64 * unit
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(target_os = "linux")]
    fn a_peak_is_forgotten() {
        const BYTES: usize = 300_000_000;
        drop(std::hint::black_box(vec![1u8; BYTES]));
        let with = peak_memory_bytes();
        forget_peak_memory();
        // Other tests take memory meanwhile, but less.
        assert!(peak_memory_bytes() + (BYTES as u64) / 2 < with);
    }

    #[test]
    fn a_process_is_found_in_what_nvidia_smi_tells() {
        let table = "812, 1500\n4711, 1832\n9, [N/A]\n";
        assert_eq!(of_process(table, 4711), Some(1832 << 20));
        assert_eq!((of_process(table, 47), of_process(table, 9), of_process("", 1)), (None, None, None));
        assert_eq!(device_memory_bytes(Device::Cpu), None);
    }
}
