//! Handling of requests to stop, by Ctrl-C, SIGTERM or SIGHUP.

use std::mem::zeroed;
use std::ptr::{null, null_mut};

/// Calls `act`, in a thread of its own, each time the process is asked to stop. SIGHUP stays ignored under `nohup`, which
/// ignores it.
///
/// The handler runs on the alternate signal stack (`SA_ONSTACK`) that Rust sets up for the main thread, to which Linux delivers
/// a signal of the process unless that thread already has one pending. Float32 matrix products of oneDNN before 3.12 point the
/// stack pointer into their own buffers (oneDNN issue 4845), so a handler on the thread's own stack would overwrite the heap.
pub fn on_stop(act: impl FnMut() + Send + 'static) -> anyhow::Result<()> {
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
