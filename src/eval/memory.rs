//! How much memory the process has taken.

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
