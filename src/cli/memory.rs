//! Handling of failed allocations, as under `ulimit -v`: one sentence and exit code 1, as for all work that fails.

use super::FAILED;
use globalsplat::config::TrainConfig;
use std::alloc::{GlobalAlloc, Layout, System};

/// Global allocator that ends the process if an allocation fails: Rust's default is to abort, with a core dump. Files are
/// written so that ending this way loses nothing.
struct OrEnd;

#[global_allocator]
static ALLOCATOR: OrEnd = OrEnd;

// SAFETY: it is the system's allocator, except for what follows a failed allocation.
unsafe impl GlobalAlloc for OrEnd {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller upholds the contract of the system's allocator.
        or_end(unsafe { System.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as in `alloc`.
        or_end(unsafe { System.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: as in `alloc`.
        or_end(unsafe { System.realloc(memory, layout, size) }, size)
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: as in `alloc`.
        unsafe { System.dealloc(memory, layout) }
    }
}

fn or_end(memory: *mut u8, bytes: usize) -> *mut u8 {
    if memory.is_null() {
        end(Some(bytes));
    }
    memory
}

/// Makes the process end with exit code 1 if an allocation fails in a library that would otherwise abort, throw where nothing
/// may be thrown, or read from address 0.
pub fn end_as_failed() {
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
    faults::tell_from_refusals();
    grow_stack();
    expect_room_for_small_pieces();
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

/// Returns `true` if the system can map that many bytes of address space. Unmaps them again.
fn is_given(bytes: usize) -> bool {
    let (protection, flags) = (libc::PROT_NONE, libc::MAP_PRIVATE | libc::MAP_ANON);
    // SAFETY: the mapping is new, untouched, and used by nobody else.
    unsafe {
        let memory = libc::mmap(std::ptr::null_mut(), bytes, protection, flags, -1, 0);
        memory != libc::MAP_FAILED && libc::munmap(memory, bytes) == 0
    }
}

/// Grows the stack of the main thread in advance. It grows on demand, and if it can't, the system ends the process with a
/// signal. It never shrinks, so what is mapped here stays mapped.
fn grow_stack() {
    const BYTES: usize = 1 << 20;
    #[inline(never)]
    fn grow() {
        std::hint::black_box([0_u8; BYTES]);
    }
    if !is_given(BYTES + (BYTES >> 2)) {
        end(None);
    }
    grow();
}

/// Checks that there is memory for small allocations. On the way to its first large tensor the process makes some whose failure
/// libraries don't handle: glibc aborts, with its own message, if it can't register the destructor of a thread-local variable.
fn expect_room_for_small_pieces() {
    const BYTES: usize = 16 << 20;
    if !is_given(BYTES) {
        end(None);
    }
}

/// Handling of reads next to address 0 by libraries that don't check whether an allocation succeeded, as oneDNN sometimes
/// doesn't.
mod faults {
    use std::mem::MaybeUninit;
    use std::ptr::null_mut;
    use std::sync::OnceLock;

    /// Previous action for SIGSEGV, restored for real faults: Rust's own handler reports stack overflows, and otherwise lets
    /// the signal end the process.
    static ACTION: OnceLock<libc::sigaction> = OnceLock::new();

    /// Installs a handler that ends the process as failed if it reads next to address 0 while the system is out of memory. All
    /// other faults are handled as before.
    pub fn tell_from_refusals() {
        // SAFETY: all zeros are a valid action; the system fills it in, and then takes one that runs on the stack that Rust set
        // aside.
        unsafe {
            let mut action = MaybeUninit::<libc::sigaction>::zeroed().assume_init();
            libc::sigaction(libc::SIGSEGV, std::ptr::null(), &mut action);
            let _ = ACTION.set(action);
            action.sa_sigaction =
                on_fault as extern "C" fn(_, *mut libc::siginfo_t, *mut libc::c_void) as libc::sighandler_t;
            action.sa_flags = libc::SA_SIGINFO | libc::SA_ONSTACK;
            libc::sigaction(libc::SIGSEGV, &action, null_mut());
        }
    }

    extern "C" fn on_fault(signal: libc::c_int, what: *mut libc::siginfo_t, _: *mut libc::c_void) {
        // No allocation lies next to address 0, and malloc requests at most a MiB from the system for a smaller allocation.
        const NEXT_TO_0: usize = 4096;
        const ASKED_FOR: usize = 1 << 20;
        // SAFETY: the system passes a valid `siginfo_t`; nothing here allocates.
        unsafe {
            if (*what).si_code > 0 && ((*what).si_addr() as usize) < NEXT_TO_0 && !super::is_given(ASKED_FOR)
            {
                super::end(None);
            }
            // With the previous action restored, the same instruction runs again and faults.
            if let Some(action) = ACTION.get() {
                libc::sigaction(signal, action, null_mut());
            }
        }
    }
}

/// Prints the out-of-memory message without allocating, once for all threads, and ends the process.
#[cold]
fn end(bytes: Option<usize>) -> ! {
    use std::io::Write;
    use std::sync::atomic::{AtomicBool, Ordering};
    static SAYING: AtomicBool = AtomicBool::new(false);
    while SAYING.swap(true, Ordering::Relaxed) {
        // SAFETY: waits for the thread that prints the message to end the process.
        unsafe { libc::pause() };
    }
    let mut text = [0; 128];
    let mut rest = &mut text[..];
    let _ = match bytes {
        Some(bytes) => writeln!(rest, "globalsplat: the system refuses {bytes} bytes of memory"),
        None => writeln!(rest, "globalsplat: out of memory"),
    };
    let left = rest.len();
    let length = text.len() - left;
    // SAFETY: the bytes are initialized, and the process ends without running anything that could allocate.
    unsafe {
        libc::write(2, text.as_ptr().cast(), length);
        libc::_exit(FAILED.into())
    }
}
