//! Handling of requests to stop, by Ctrl-C, SIGTERM or SIGHUP.

use super::FAILED;
use anyhow::Result;
use std::mem::zeroed;
use std::ptr::{null, null_mut};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Message if the user stops the program before there is a splat.
const NOTHING_YET: &str = "stopped before there was a splat: nothing is written";

/// Calls `act`, in a thread of its own, each time the process is asked to stop. SIGHUP stays ignored under `nohup`, which
/// ignores it.
///
/// The handler runs on the alternate signal stack (`SA_ONSTACK`) that Rust sets up for the main thread, to which Linux delivers
/// a signal of the process unless that thread already has one pending. Float32 matrix products of oneDNN before 3.12 point the
/// stack pointer into their own buffers (oneDNN issue 4845), so a handler on the thread's own stack would overwrite the heap.
pub fn on_stop(act: impl FnMut() + Send + 'static) -> Result<()> {
    let hang_up = action_of(libc::SIGHUP);
    ctrlc::set_handler(act)?;
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

/// Request of the user or the system to stop, by Ctrl-C or SIGTERM.
#[derive(Clone, Default)]
pub struct StopRequest {
    is_requested: Arc<AtomicBool>,
    ends_at_once: Arc<AtomicBool>,
}

impl StopRequest {
    /// Installs the signal handlers. The first request ends the process immediately as long as there is no splat to keep, a
    /// second one at any time: files are written whole or not at all.
    pub fn install() -> Result<Self> {
        let request = StopRequest::default();
        request.set_ends_at_once(true);
        let handler = request.clone();
        on_stop(move || {
            let is_second = handler.is_requested.swap(true, Ordering::Relaxed);
            if is_second || handler.ends_at_once.load(Ordering::Relaxed) {
                eprintln!("globalsplat: {}", if is_second { "stopped at once" } else { NOTHING_YET });
                // SAFETY: `_exit` ends the process without running destructors of libraries, which would wait for the working
                // threads.
                unsafe { libc::_exit(FAILED.into()) }
            }
        })?;
        Ok(request)
    }

    pub fn set_ends_at_once(&self, ends: bool) {
        self.ends_at_once.store(ends, Ordering::Relaxed);
    }

    pub fn is_requested(&self) -> bool {
        self.is_requested.load(Ordering::Relaxed)
    }
}
