//! The `globalsplat` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    #[cfg(target_os = "macos")]
    limit_spinning();
    globalsplat::main()
}

/// Lets the threads of LLVM's OpenMP, which libtorch has on macOS, sleep after a millisecond of waiting instead of 200, unless the user
/// has set how they wait. It reads its environment when it is first used.
#[cfg(target_os = "macos")]
fn limit_spinning() {
    if ["KMP_BLOCKTIME", "OMP_WAIT_POLICY"].iter().all(|name| std::env::var_os(name).is_none()) {
        // SAFETY: no other thread runs yet.
        unsafe { std::env::set_var("KMP_BLOCKTIME", "1") };
    }
}

/// Lets the threads of GNU's OpenMP sleep after a tenth of a millisecond of waiting instead of several, unless the user has set how they
/// wait: while they spin, our own kernels and other processes lack their cores (docs/robustness.md).
///
/// OpenMP reads its environment when it is loaded. Functions in `.preinit_array` run before that, but can't change the environment, so the
/// program starts once more in the same process. If it can't, it only runs slower.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
mod spinning {
    use std::ffi::{CStr, c_char, c_int};
    use std::ptr;

    const SPIN_COUNT: &CStr = c"GOMP_SPINCOUNT=10000";
    /// Variables by which users set how threads wait.
    const VARIABLES: [&[u8]; 2] = [b"GOMP_SPINCOUNT=", b"OMP_WAIT_POLICY="];

    #[used]
    #[unsafe(link_section = ".preinit_array")]
    static LIMIT: unsafe extern "C" fn(c_int, *const *const c_char, *const *const c_char) = limit;

    unsafe extern "C" fn limit(_: c_int, arguments: *const *const c_char, environment: *const *const c_char) {
        // SAFETY: the loader passes two lists of strings that end with a null pointer, as `execve` takes them.
        unsafe {
            let count = (0..).take_while(|&index| !(*environment.add(index)).is_null()).count();
            let mut environment = std::slice::from_raw_parts(environment, count).to_vec();
            let is_set = |&entry: &*const c_char| {
                VARIABLES.iter().any(|name| CStr::from_ptr(entry).to_bytes().starts_with(name))
            };
            if !environment.iter().any(is_set) {
                environment.extend([SPIN_COUNT.as_ptr(), ptr::null()]);
                libc::execve(c"/proc/self/exe".as_ptr(), arguments, environment.as_ptr());
            }
        }
    }
}
