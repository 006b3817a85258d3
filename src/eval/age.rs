//! How long the process has lived.

use std::time::Duration;

/// Since the system began to load the program, to a hundredth of a second: libtorch is large. Linux alone tells.
pub fn process_age() -> Option<Duration> {
    // Behind the name, which may hold anything: the 22nd field, in ticks since the system's start.
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    let began: f64 = stat.rsplit_once(')')?.1.split_whitespace().nth(19)?.parse().ok()?;
    let uptime = std::fs::read_to_string("/proc/uptime").ok()?;
    let now: f64 = uptime.split(' ').next()?.parse().ok()?;
    // SAFETY: sysconf only tells a number.
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
