//! Handling of failed allocations, as under `ulimit -v`: one sentence and exit code 1, as for all work that fails.

use super::FAILED;
use globalsplat::config::TrainConfig;
use std::alloc::{GlobalAlloc, Layout, System};
use std::io::Write;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Global allocator that ends the process if an allocation fails: Rust's default is to abort, with a core dump. Files are
/// written so that ending this way loses nothing.
struct ExitOnFailedAllocation;

/// `true` once a thread has printed that memory is out: others that run out of it at the same time stay silent.
static IS_REPORTED: AtomicBool = AtomicBool::new(false);

#[global_allocator]
static ALLOCATOR: ExitOnFailedAllocation = ExitOnFailedAllocation;

// SAFETY: it forwards to the system's allocator, and ends the process if an allocation fails.
unsafe impl GlobalAlloc for ExitOnFailedAllocation {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller upholds the contract of the system's allocator.
        exit_if_null(unsafe { System.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as in `alloc`.
        exit_if_null(unsafe { System.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: as in `alloc`.
        exit_if_null(unsafe { System.realloc(memory, layout, size) }, size)
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: as in `alloc`.
        unsafe { System.dealloc(memory, layout) }
    }
}

fn exit_if_null(memory: *mut u8, bytes: usize) -> *mut u8 {
    if memory.is_null() {
        end(Some(bytes));
    }
    memory
}

/// Makes the process end with exit code 1 if C++'s `new` can't allocate, or if a library aborts.
pub fn install_failure_handlers() {
    extern "C" fn end_quietly(_: libc::c_int) {
        // SAFETY: `_exit` ends the process, which is allowed in a signal handler.
        unsafe { libc::_exit(FAILED.into()) }
    }
    extern "C" fn end_of_cpp() {
        end(None);
    }
    unsafe extern "C" {
        /// Binds `std::set_new_handler`, which sets the function that C++ calls if `new` can't allocate.
        #[link_name = "_ZSt15set_new_handlerPFvvE"]
        fn set_new_handler(handler: extern "C" fn()) -> Option<extern "C" fn()>;
    }
    // SAFETY: the handlers do only what handlers may do. A library that aborts, as glibc, has already printed why.
    unsafe {
        libc::signal(libc::SIGABRT, end_quietly as extern "C" fn(libc::c_int) as libc::sighandler_t);
        set_new_handler(end_of_cpp);
    }
    // If there is no memory for the stack trace of an error, which nobody sees, libtorch reads it from address 0.
    globalsplat_csrc::render::disable_stack_traces();
}

/// Makes the process return large tensors to the system when they are freed, until [`keep`] is called. This is for work that converts many
/// photos: what it keeps of each would leave gaps between them in which no large tensor fits, several times as much as it keeps.
pub fn return_large_tensors() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: the call sets a parameter of the allocator, and by that keeps glibc from raising it.
    unsafe {
        const LARGE: libc::c_int = 1 << 20;
        libc::mallopt(libc::M_MMAP_THRESHOLD, LARGE);
    }
}

/// Makes the process keep freed memory, for commands that allocate the same sizes again and again: the system zeroes every page
/// that it hands out, which takes up to a sixth of a training step and a tenth of a step of refinement. By default glibc
/// returns the memory of large tensors to the system.
pub fn keep() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: the calls set parameters of the allocator.
    unsafe {
        libc::mallopt(libc::M_MMAP_MAX, 0);
        libc::mallopt(libc::M_TRIM_THRESHOLD, -1);
    }
}

/// Calls [`keep`] for training, unless its rounds are recomputed to save memory: keeping takes a tenth more memory, and with
/// recomputed rounds a third more.
pub fn keep_for(training: &TrainConfig) {
    if !training.checkpoint_rounds {
        keep();
    }
}

/// Runs `work` with [`keep`] in effect, and afterwards returns unused memory to the system.
pub fn keep_during<T>(work: impl FnOnce() -> T) -> T {
    keep();
    let done = work();
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: the calls set parameters of the allocator and make it release unused pages.
    unsafe {
        // Threshold that glibc itself reaches after some allocations of large tensors.
        const LARGEST_KEPT: libc::c_int = 32 << 20;
        libc::mallopt(libc::M_MMAP_MAX, 65_536);
        libc::mallopt(libc::M_MMAP_THRESHOLD, LARGEST_KEPT);
        libc::mallopt(libc::M_TRIM_THRESHOLD, 2 * LARGEST_KEPT);
        libc::malloc_trim(0);
    }
    done
}

/// Prints the out-of-memory message, and ends the process. Neither needs to allocate.
#[cold]
fn end(bytes: Option<usize>) -> ! {
    while IS_REPORTED.swap(true, Ordering::Relaxed) {
        // Another thread is printing, and then ends the process.
        std::thread::sleep(Duration::from_secs(1));
    }
    // Standard error may be closed.
    let mut stderr = std::io::stderr();
    let _ = match bytes {
        Some(bytes) => {
            writeln!(stderr, "globalsplat: out of memory: an allocation of {bytes} bytes failed")
        }
        None => writeln!(stderr, "globalsplat: out of memory"),
    };
    // SAFETY: nothing else runs in this process.
    unsafe { libc::_exit(FAILED.into()) }
}
