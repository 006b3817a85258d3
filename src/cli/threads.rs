//! How libtorch's threads wait for each other.

use std::env;
use std::process::Command;

/// How often one of GCC's OpenMP threads looks whether the others are done before it sleeps; by default 300,000 times, which
/// takes milliseconds. Measured with `scripts/busy.py`: with fewer looks, threads that have a machine for themselves are woken
/// more often than pays, and with more they take the time of those that don't.
const SPINS: (&str, &str) = ("GOMP_SPINCOUNT", "500");

/// Also tells OpenMP's threads how to wait. Whoever sets it knows why.
const POLICY: &str = "OMP_WAIT_POLICY";

/// Has them sleep soon. As soon as anything else takes a core, threads that spin for each other spin away the time of the very
/// one that they wait for, at every one of thousands of operations, and training slows down to a quarter. OpenMP looks at its
/// variables when it is loaded, before `main`, so the program starts itself anew.
pub fn sleep_soon() {
    let alone = env::var("OMP_NUM_THREADS").is_ok_and(|threads| threads == "1");
    if alone || [SPINS.0, POLICY].iter().any(|variable| env::var_os(variable).is_some()) {
        return;
    }
    #[cfg(unix)]
    if let Ok(program) = env::current_exe() {
        use std::os::unix::process::CommandExt;
        let mut arguments = env::args_os();
        let mut again = Command::new(program);
        if let Some(name) = arguments.next() {
            again.arg0(name);
        }
        // Only returns where that can't be done, and then threads spin.
        let _ = again.args(arguments).env(SPINS.0, SPINS.1).exec();
    }
}
