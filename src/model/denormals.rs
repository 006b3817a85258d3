//! Flushing of denormal numbers, below 1.2e-38 in float32, to zero. Denormals lose digits towards 0, and Intel's processors compute many
//! times as slowly with them as with other numbers.
//!
//! They most likely come from attention, which is sharp after training, and from its gradients: without them, continued training of small
//! models takes half the time (docs/training.md). No result depends on them.

use globalsplat_csrc::processor as ffi;
use std::hint::black_box;
use std::thread;

/// Makes this thread, and on Linux all threads that it starts later, treat denormal numbers as 0. Call it on a program's first thread,
/// before there are others. A no-op on processors that don't support it.
///
/// Rust assumes that nobody changes this mode: values computed at compile time may still be denormal. The same sum may therefore be 0 at
/// run time and 1e-40 at compile time. Don't call this if values near 1e-40 matter.
pub fn flush_denormals() {
    ffi::flush_denormals();
}

/// Returns `true` if a thread started by this one treats denormal numbers as 0.
pub fn are_denormals_flushed() -> bool {
    let started = thread::spawn(|| black_box(f32::MIN_POSITIVE) * black_box(0.5) == 0.);
    started.join().expect("a product")
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::Tensor;

    #[test]
    fn denormals_are_zero_on_all_threads() {
        // Enough elements for libtorch to split them among its threads, which it starts separately for each calling thread.
        const MANY: i64 = 1 << 20;
        let left = || {
            let halves = Tensor::from(f32::MIN_POSITIVE).repeat([MANY]) * 0.5;
            (are_denormals_flushed(), i64::try_from(halves.count_nonzero(0)).unwrap())
        };
        let of_a_thread = |work: fn()| thread::spawn(move || (work(), left()).1).join().unwrap();
        assert_eq!(of_a_thread(|| ()), (false, MANY));
        assert_eq!(of_a_thread(flush_denormals), (true, 0));
    }
}
