//! Age of the running process.

use std::time::Duration;

/// Returns the time since the system began to load the program, to a hundredth of a second. It includes the loading of libtorch, which is
/// large. Returns `None` on systems other than Linux.
pub fn process_age() -> Option<Duration> {
    // The start time is the 22nd field, in clock ticks since boot. Count the fields after the program's name, which may contain anything.
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    let began: f64 = stat.rsplit_once(')')?.1.split_whitespace().nth(19)?.parse().ok()?;
    let uptime = std::fs::read_to_string("/proc/uptime").ok()?;
    let now: f64 = uptime.split(' ').next()?.parse().ok()?;
    // SAFETY: `sysconf` only returns a number.
    let ticks = unsafe { libc::sysconf(libc::_SC_CLK_TCK) } as f64;
    Duration::try_from_secs_f64(now - began / ticks).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(target_os = "linux")]
    fn a_process_grows_older() {
        let before = process_age().expect("an age");
        std::thread::sleep(Duration::from_millis(60));
        let grown = process_age().expect("an age") - before;
        assert!((Duration::from_millis(30)..Duration::from_secs(30)).contains(&grown), "{grown:?}");
    }
}
