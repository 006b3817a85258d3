//! Handling of requests to stop, by Ctrl-C, SIGTERM or SIGHUP.

use super::FAILED;
use libc::{
    SA_ONSTACK, SA_RESTART, SIG_IGN, SIGHUP, SIGINT, SIGTERM, STDERR_FILENO, c_int, sigaction, sigfillset,
};
use std::mem::zeroed;
use std::ptr::{null, null_mut};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Number of requests to stop so far, and of the request that ends the process immediately, at first none. Both are the process's, as
/// signals are.
static REQUESTS: AtomicUsize = AtomicUsize::new(0);
static LAST_REQUEST: AtomicUsize = AtomicUsize::new(usize::MAX);

/// Returns `true` once the user or the system has asked the program to stop.
pub fn is_stop_requested() -> bool {
    REQUESTS.load(Ordering::Relaxed) > 0
}

/// Makes the request to stop with this `number` end the process immediately: 1 as long as there is nothing to keep, or 2 if the work ends
/// by itself after the first. Files are written whole or not at all.
pub fn end_at_request(number: usize) {
    LAST_REQUEST.store(number, Ordering::Relaxed);
}

/// Installs the signal handlers. SIGHUP stays ignored under `nohup`, which ignores it.
///
/// The handler runs on the alternate signal stack (`SA_ONSTACK`) that Rust sets up for the main thread, to which Linux delivers
/// a signal of the process unless that thread already has one pending. Float32 matrix products of oneDNN before 3.12 point the
/// stack pointer into their own buffers (oneDNN issue 4845), so a handler on the thread's own stack would overwrite the heap.
pub fn handle_stop_requests() {
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        // SAFETY: an action is plain data for which zero is a valid value, and the handler calls only what a handler may.
        unsafe {
            let (mut action, mut old): (sigaction, sigaction) = (zeroed(), zeroed());
            sigaction(signal, null(), &mut old);
            if signal == SIGHUP && old.sa_sigaction == SIG_IGN {
                continue;
            }
            action.sa_sigaction = count_request as extern "C" fn(c_int) as usize;
            action.sa_flags = SA_RESTART | SA_ONSTACK;
            // One handler at a time: the alternate stack is large enough for one frame.
            sigfillset(&mut action.sa_mask);
            sigaction(signal, &action, null_mut());
        }
    }
}

extern "C" fn count_request(_: c_int) {
    let number = REQUESTS.fetch_add(1, Ordering::Relaxed) + 1;
    if number < LAST_REQUEST.load(Ordering::Relaxed) {
        return;
    }
    let message = match number {
        1 => "globalsplat: stopped before there was a splat: nothing is written\n",
        _ => "globalsplat: stopped at once\n",
    };
    // SAFETY: `_exit` ends the process without running destructors of libraries, which would wait for the working threads.
    unsafe {
        libc::write(STDERR_FILENO, message.as_ptr().cast(), message.len());
        libc::_exit(FAILED.into())
    }
}
