//! What the user or the system asks for by Ctrl-C, SIGTERM or SIGHUP.

use std::ptr::{null, null_mut};

/// Calls `act`, in a thread of its own, each time that the process is asked to stop.
///
/// The signal's handler runs on the stack that Rust sets aside in the main thread, which the system hands such signals to. In float32
/// products oneDNN has let the stack pointer point into its buffers (oneDNN's issue 4845, mended in its version 3.12): the frame
/// of a handler on the thread's own stack would lie amid the heap.
pub fn on_stop(act: impl FnMut() + Send + 'static) -> anyhow::Result<()> {
    ctrlc::set_handler(act)?;
    for signal in [libc::SIGINT, libc::SIGTERM, libc::SIGHUP] {
        // SAFETY: the system fills in the action that is there, and takes it back with one flag more.
        unsafe {
            let mut action: libc::sigaction = std::mem::zeroed();
            libc::sigaction(signal, null(), &mut action);
            action.sa_flags |= libc::SA_ONSTACK;
            libc::sigaction(signal, &action, null_mut());
        }
    }
    Ok(())
}
