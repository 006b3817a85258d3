//! Handling of requests to stop, by Ctrl-C, SIGTERM or SIGHUP.

use super::FAILED;
use anyhow::Result;
use std::mem::zeroed;
use std::ptr::{null, null_mut};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Message if the user stops the program before there is a splat.
const NOTHING_YET: &str = "stopped before there was a splat: nothing is written";

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

/// Installs the signal handlers, once in a process. SIGHUP stays ignored under `nohup`, which ignores it.
///
/// The handler runs on the alternate signal stack (`SA_ONSTACK`) that Rust sets up for the main thread, to which Linux delivers
/// a signal of the process unless that thread already has one pending. Float32 matrix products of oneDNN before 3.12 point the
/// stack pointer into their own buffers (oneDNN issue 4845), so a handler on the thread's own stack would overwrite the heap.
pub fn handle_stop_requests() -> Result<()> {
    static INSTALLED: AtomicBool = AtomicBool::new(false);
    if INSTALLED.swap(true, Ordering::Relaxed) {
        return Ok(());
    }
    let hang_up = action_of(libc::SIGHUP);
    ctrlc::set_handler(|| {
        let number = REQUESTS.fetch_add(1, Ordering::Relaxed) + 1;
        if number >= LAST_REQUEST.load(Ordering::Relaxed) {
            eprintln!("globalsplat: {}", if number > 1 { "stopped at once" } else { NOTHING_YET });
            // SAFETY: `_exit` ends the process without running destructors of libraries, which would wait for the working threads.
            unsafe { libc::_exit(FAILED.into()) }
        }
    })?;
    for signal in [libc::SIGINT, libc::SIGTERM, libc::SIGHUP] {
        let mut action = action_of(signal);
        action.sa_flags |= libc::SA_ONSTACK;
        // One handler at a time: the alternate stack is large enough for one frame.
        // SAFETY: the pointer is to an initialized set of signals.
        unsafe { libc::sigfillset(&mut action.sa_mask) };
        set_action(signal, &action);
    }
    if hang_up.sa_sigaction == libc::SIG_IGN {
        set_action(libc::SIGHUP, &hang_up);
    }
    Ok(())
}

fn action_of(signal: libc::c_int) -> libc::sigaction {
    // SAFETY: an action is plain data for which zero is a valid value, and the system fills it in.
    unsafe {
        let mut action = zeroed();
        libc::sigaction(signal, null(), &mut action);
        action
    }
}

fn set_action(signal: libc::c_int, action: &libc::sigaction) {
    // SAFETY: the action came from the system, and its handler is a valid function.
    unsafe { libc::sigaction(signal, action, null_mut()) };
}
