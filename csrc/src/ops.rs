//! Which ops libtorch is asked for.

#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("ops.h");

        /// See `csrc/ops.h`.
        fn note_ops(outermost: bool);

        /// See `csrc/ops.h`.
        fn noted_ops() -> Vec<String>;
    }
}

/// What `work` gives, and the ops that it had libtorch do on this thread, by the names that `csrc/ops.h` tells, in their order: those
/// inside of others, and of backward passes on the CPU, too.
pub fn ops_of<T>(work: impl FnOnce() -> T) -> (T, Vec<String>) {
    ffi::note_ops(false);
    let done = work();
    (done, ffi::noted_ops())
}

/// Runs `work` and returns its result and the outermost libtorch ops that it ran on this thread, in order.
pub fn outermost_ops_of<T>(work: impl FnOnce() -> T) -> (T, Vec<String>) {
    ffi::note_ops(true);
    let done = work();
    (done, ffi::noted_ops())
}
