//! How much memory the process has taken.

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
