//! Guard against oversubscription: changes how OpenMP's threads wait when other processes use the same cores.
//!
//! Between two operations a thread of libgomp, the OpenMP runtime of libtorch, spins for milliseconds until the next one. This
//! is the fastest way to wait if the process is alone. If another process takes a core, threads spin while they wait for one
//! that isn't running, and training slows down several times. libgomp itself hardly spins once it manages more threads than
//! there are cores. So while other processes take cores, we start an additional team of threads that does nothing. The number
//! of working threads doesn't change, since results depend on it.

use std::fs::read_to_string;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};
use tch::{Device, Kind, Tensor};

/// Interval between two measurements of CPU time: some clock ticks, the unit in which the system counts.
const INTERVAL: Duration = Duration::from_millis(200);

/// Fraction of a core that other processes may take before threads stop spinning, and the fraction below which they spin again.
const START_THRESHOLD: f64 = 0.25;
const STOP_THRESHOLD: f64 = 0.1;

/// Guard against oversubscription, which runs until it is dropped: while other processes take cores, libtorch's threads don't spin while
/// they wait for each other, which would slow down work on small tensors several times. The number of threads doesn't change.
#[derive(Debug)]
pub struct OversubscriptionGuard(#[expect(dead_code, reason = "is only dropped")] Option<Background>);

impl OversubscriptionGuard {
    /// Starts the guard. If the CPU time of other processes can't be measured, as on other systems than Linux, threads wait as usual.
    pub fn start() -> Self {
        OversubscriptionGuard(start_thread())
    }
}

/// Starts the guard's thread.
fn start_thread() -> Option<Background> {
    // Without the guard's thread, the program runs as if no other process used the cores.
    Background::start("oversub", |until: Receiver<()>| {
        let mut idle_teams = Vec::new();
        let mut before = Times::now();
        while until.recv_timeout(INTERVAL) == Err(RecvTimeoutError::Timeout) {
            let now = Times::now();
            let (Some(then), Some(later)) = (&before, &now) else { return };
            let threads = tch::get_num_threads() as usize;
            let missing = threads as f64 + later.others_since(then) - later.cores as f64;
            if threads < 2 || missing < STOP_THRESHOLD {
                idle_teams.clear();
            } else if missing > START_THRESHOLD && idle_teams.is_empty() {
                // More threads than cores are needed: one team is enough unless the user asked for fewer threads.
                let teams = (later.cores + 1).saturating_sub(threads).div_ceil(threads - 1);
                idle_teams.extend((0..teams).map_while(|_| start_idle_team()));
            }
            before = now;
        }
    })
}

/// Starts an additional, sleeping team of libgomp threads that lives until the returned value is dropped.
fn start_idle_team() -> Option<Background> {
    Background::start("idle_team", |until: Receiver<()>| {
        // A thread that libgomp didn't start gets its own team at its first parallel op, and keeps the team until it ends. This op is
        // large enough for libtorch to split across threads.
        let _ = Tensor::zeros(1 << 17, (Kind::Uint8, Device::Cpu)).bitwise_not();
        let _ = until.recv();
    })
}

/// Background thread that ends and is joined when this is dropped: a detached thread may still be inside libtorch when the
/// process unloads libtorch.
#[derive(Debug)]
struct Background {
    tell: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Background {
    /// Starts the thread, or returns `None` if the system refuses to create one.
    fn start(name: &str, work: impl FnOnce(Receiver<()>) + Send + 'static) -> Option<Background> {
        let (tell, until) = channel();
        let thread = Builder::new().name(name.into()).spawn(move || work(until)).ok()?;
        Some(Background { tell: Some(tell), thread: Some(thread) })
    }
}

impl Drop for Background {
    fn drop(&mut self) {
        self.tell = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// CPU time used so far, on the cores that this process may use.
struct Times {
    at: Instant,
    cores: usize,
    /// CPU time of all processes, in seconds.
    all: f64,
    /// CPU time of this process, in seconds.
    own: f64,
}

impl Times {
    #[cfg(not(target_os = "linux"))]
    fn now() -> Option<Times> {
        None
    }

    #[cfg(target_os = "linux")]
    fn now() -> Option<Times> {
        // SAFETY: both are plain data for which zero is a valid value, and the calls fill them.
        let (set, usage, tick) = unsafe {
            let mut set: libc::cpu_set_t = std::mem::zeroed();
            let mut usage: libc::rusage = std::mem::zeroed();
            let known = libc::sched_getaffinity(0, size_of_val(&set), &mut set) == 0
                && libc::getrusage(libc::RUSAGE_SELF, &mut usage) == 0;
            known.then(|| (set, usage, 1.0 / libc::sysconf(libc::_SC_CLK_TCK) as f64))
        }?;
        let seconds = |time: libc::timeval| time.tv_sec as f64 + 1e-6 * time.tv_usec as f64;
        let own = seconds(usage.ru_utime) + seconds(usage.ru_stime);
        // SAFETY: the index is within the bits of the set.
        let ours = |core: usize| core < libc::CPU_SETSIZE as usize && unsafe { libc::CPU_ISSET(core, &set) };
        let table = read_to_string("/proc/stat").ok()?;
        let busy: Vec<u64> = table.lines().filter_map(|line| busy_ticks(line, ours)).collect();
        let all = tick * busy.iter().sum::<u64>() as f64;
        Some(Times { at: Instant::now(), cores: busy.len(), all, own })
    }

    /// Returns the number of cores that other processes used since `then`.
    fn others_since(&self, then: &Times) -> f64 {
        ((self.all - then.all) - (self.own - then.own)) / (self.at - then.at).as_secs_f64()
    }
}

/// Returns the clock ticks that one of our cores was busy for, from its line in `/proc/stat`: `cpuN user nice system idle
/// iowait irq softirq steal …` (proc_stat(5)).
fn busy_ticks(line: &str, ours: impl Fn(usize) -> bool) -> Option<u64> {
    let mut words = line.strip_prefix("cpu")?.split(' ');
    if !ours(words.next()?.parse().ok()?) {
        return None;
    }
    let ticks: Vec<u64> = words.map_while(|word| word.parse().ok()).take(8).collect();
    let [user, nice, system, _, _, irq, softirq, steal] = ticks.try_into().ok()?;
    Some(user + nice + system + irq + softirq + steal)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::thread::sleep;

    #[test]
    fn ticks_are_of_our_cores_and_leave_out_waiting() {
        let ours = |core: usize| core != 1;
        assert_eq!(
            busy_ticks("cpu0 1 20 300 4000 50000 600000 7000000 80000000 5 5", ours),
            Some(87_600_321)
        );
        for other in
            ["cpu  1 2 3 4 5 6 7 8 9 10", "cpu1 1 2 3 4 5 6 7 8 9 10", "cpu2 1 2 3 4 5 6", "intr 5 0", ""]
        {
            assert_eq!(busy_ticks(other, ours), None, "{other}");
        }
    }

    #[test]
    fn load_of_other_processes_excludes_this_process() {
        let then = Times { at: Instant::now(), cores: 2, all: 10.0, own: 4.0 };
        let later = Times { at: then.at + Duration::from_secs(2), cores: 2, all: 13.0, own: 6.0 };
        assert_eq!(later.others_since(&then), 0.5);
    }

    /// Returns the number of threads of this process with that name. The threads of a team inherit the name of the thread that
    /// the team was created for.
    fn called(name: &str) -> usize {
        let tasks = std::fs::read_dir("/proc/self/task").unwrap();
        let names = tasks.filter_map(|task| read_to_string(task.ok()?.path().join("comm")).ok());
        names.filter(|found| found.trim_end() == name).count()
    }

    fn becomes(name: &str, count: usize) -> bool {
        (0..5000).any(|_| called(name) == count || (sleep(Duration::from_millis(1)), false).1)
    }

    #[test]
    fn idle_team_lives_until_dropped() {
        tch::set_num_threads(3);
        let team = start_idle_team().unwrap();
        assert!(becomes("idle_team", 3), "{}", called("idle_team"));
        drop(team);
        assert!(becomes("idle_team", 0), "{}", called("idle_team"));
    }

    #[test]
    fn guard_thread_ends_when_dropped() {
        let guard = OversubscriptionGuard::start();
        assert!(becomes("oversub", 1), "{}", called("oversub"));
        drop(guard);
        assert!(becomes("oversub", 0), "{}", called("oversub"));
    }
}
