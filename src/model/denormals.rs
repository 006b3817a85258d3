//! Numbers next to 0, below 1.2e-38 in float32: they have fewer digits the smaller they are, and Intel's processors are many times as
//! slow with them as with others.
//!
//! Most likely it is attention that makes them, which is sharp once it has learned, and its gradients: small models train on in half
//! the time without them (docs/training.md). No result depends on them.

use globalsplat_csrc::processor as ffi;
use std::hint::black_box;
use std::thread;

/// Has this thread take them for 0 from now on, and with it all threads that it starts, which on Linux inherit it. So it is for a
/// program's first thread, before there are others. Where the processor can't, they stay.
///
/// Rust takes for granted that nobody does this: what it computes as it compiles may still have such numbers in it. The same
/// sum may therefore be 0 here and 1e-40 there; who cares about 1e-40 should leave it alone.
pub fn flush_denormals() {
    ffi::flush_denormals();
}

/// Whether a thread that this one starts takes them for 0.
pub fn are_denormals_flushed() -> bool {
    let started = thread::spawn(|| black_box(f32::MIN_POSITIVE) * black_box(0.5) == 0.);
    started.join().expect("a product")
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::Tensor;

    #[test]
    fn all_threads_take_them_for_0() {
        // So many that libtorch shares them among threads, which it starts for each thread that has it compute.
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
