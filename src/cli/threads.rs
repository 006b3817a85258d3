//! How libtorch's threads wait for each other.

use std::env;
use std::process::Command;

/// What tells OpenMP, GCC's or LLVM's, how its threads wait. Whoever sets one knows why.
const VARIABLES: [&str; 3] = ["OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME"];

/// Has them sleep. OpenMP's threads spin for milliseconds by default, each for the others: as soon as anything else takes a
/// core, they spin away the time of the very thread that they wait for, at every one of thousands of operations, and training
/// comes to a halt. OpenMP looks at its variables when it is loaded, before `main`, so the program starts itself anew.
pub fn sleep_while_waiting() {
    let alone = env::var("OMP_NUM_THREADS").is_ok_and(|threads| threads == "1");
    if alone || VARIABLES.iter().any(|variable| env::var_os(variable).is_some()) {
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
        let _ = again.args(arguments).env(VARIABLES[0], "passive").exec();
    }
}
