//! Memory that the system refuses, as under `ulimit -v`: one sentence and exit code 1, as for all work that fails.

use super::FAILED;
use globalsplat::config::TrainConfig;
use std::alloc::{GlobalAlloc, Layout, System};

/// Ends the process where no memory is to be had: Rust's own answer is to abort, with a core dump. Files are written so that
/// nothing is lost by it.
struct OrEnd;

#[global_allocator]
static ALLOCATOR: OrEnd = OrEnd;

// SAFETY: it is the system's allocator, but for what comes after a refusal.
unsafe impl GlobalAlloc for OrEnd {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller's promises are the system allocator's.
        or_end(unsafe { System.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as above.
        or_end(unsafe { System.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: as above.
        or_end(unsafe { System.realloc(memory, layout, size) }, size)
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(memory, layout) }
    }
}

fn or_end(memory: *mut u8, bytes: usize) -> *mut u8 {
    if memory.is_null() {
        end(Some(bytes));
    }
    memory
}

/// Has the process end with exit code 1 where a library below is refused memory, and would abort, throw where nothing may be
/// thrown, or read from address 0.
pub fn end_as_failed() {
    extern "C" fn end_quietly(_: libc::c_int) {
        // SAFETY: ends the process, which is allowed in a signal's handler.
        unsafe { libc::_exit(FAILED.into()) }
    }
    extern "C" fn end_of_cpp() {
        end(None);
    }
    unsafe extern "C" {
        /// `std::set_new_handler`: what C++ calls where `new` gets no memory.
        #[link_name = "_ZSt15set_new_handlerPFvvE"]
        fn set_new_handler(handler: extern "C" fn()) -> Option<extern "C" fn()>;
    }
    // SAFETY: the handlers do nothing that handlers may not. Who aborts, as glibc, has said why.
    unsafe {
        libc::signal(libc::SIGABRT, end_quietly as extern "C" fn(libc::c_int) as libc::sighandler_t);
        set_new_handler(end_of_cpp);
    }
    // Where libtorch has no memory for the stack trace of an error, which nobody sees, it reads it from address 0.
    globalsplat::error::leave_out_stack_traces();
    faults::tell_from_refusals();
    grow_stack();
    expect_room_for_small_pieces();
}

/// Has the process keep the memory that it gives back, for commands that ask for the same again and again: the system zeroes every
/// page that it hands out, which is up to a sixth of a training step and a tenth of a step of refinement. glibc alone gives large
/// tensors' memory back.
pub fn keep() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: sets numbers of the allocator.
    unsafe {
        libc::mallopt(libc::M_MMAP_MAX, 0);
        libc::mallopt(libc::M_TRIM_THRESHOLD, -1);
    }
}

/// The same for training. It takes a tenth more, and with rounds computed again a third: who asks for these, to save memory, does
/// without it.
pub fn keep_for(training: &TrainConfig) {
    if !training.checkpoint_rounds {
        keep();
    }
}

/// `work` with [`keep`], for as long as it lasts; then what nobody uses goes back to the system.
pub fn keep_during<T>(work: impl FnOnce() -> T) -> T {
    keep();
    let done = work();
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: sets numbers of the allocator, and has it look through what it keeps.
    unsafe {
        // What glibc comes to by itself after a while of large tensors.
        const LARGEST_KEPT: libc::c_int = 32 << 20;
        libc::mallopt(libc::M_MMAP_MAX, 65_536);
        libc::mallopt(libc::M_MMAP_THRESHOLD, LARGEST_KEPT);
        libc::mallopt(libc::M_TRIM_THRESHOLD, 2 * LARGEST_KEPT);
        libc::malloc_trim(0);
    }
    done
}

/// Whether the system gives so many bytes of address space. It takes them back.
fn is_given(bytes: usize) -> bool {
    let (protection, flags) = (libc::PROT_NONE, libc::MAP_PRIVATE | libc::MAP_ANON);
    // SAFETY: memory that nobody else has comes and goes, without being touched.
    unsafe {
        let memory = libc::mmap(std::ptr::null_mut(), bytes, protection, flags, -1, 0);
        memory != libc::MAP_FAILED && libc::munmap(memory, bytes) == 0
    }
}

/// The stack of the main thread grows as it is needed; where it can't any more, the system ends the process with a signal. It
/// never shrinks, so that what is had here stays.
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

/// On the way to its first large tensor the process takes small pieces that libraries don't bear to be refused: glibc aborts, in words
/// of its own, where it has no place for the destructor of a thread's variable.
fn expect_room_for_small_pieces() {
    const BYTES: usize = 16 << 20;
    if !is_given(BYTES) {
        end(None);
    }
}

/// Libraries that don't ask whether they were given memory, as oneDNN doesn't always, read next to address 0.
mod faults {
    use std::mem::MaybeUninit;
    use std::ptr::null_mut;
    use std::sync::OnceLock;

    /// What is done about a fault that is one: Rust's own handler tells of stacks that overflow, and else has the system end the
    /// process by the signal.
    static ACTION: OnceLock<libc::sigaction> = OnceLock::new();

    /// Has the process end as failed where it reads next to address 0 while the system refuses memory. Every other fault is what
    /// it was.
    pub fn tell_from_refusals() {
        // SAFETY: all zeros are an action; the system fills it in, and then takes one that runs on the stack that Rust set aside.
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
        // What is next to address 0 is never given, and malloc asks the system for a MiB at most where it wants less.
        const NEXT_TO_0: usize = 4096;
        const ASKED_FOR: usize = 1 << 20;
        // SAFETY: the system passes what it knows of the signal; nothing here needs memory.
        unsafe {
            if (*what).si_code > 0 && ((*what).si_addr() as usize) < NEXT_TO_0 && !super::is_given(ASKED_FOR)
            {
                super::end(None);
            }
            // The same instruction runs once more, and faults.
            if let Some(action) = ACTION.get() {
                libc::sigaction(signal, action, null_mut());
            }
        }
    }
}

/// Says so without taking memory for it, once for all threads.
#[cold]
fn end(bytes: Option<usize>) -> ! {
    use std::io::Write;
    use std::sync::atomic::{AtomicBool, Ordering};
    static SAYING: AtomicBool = AtomicBool::new(false);
    while SAYING.swap(true, Ordering::Relaxed) {
        // SAFETY: waits for the thread that says it to end the process.
        unsafe { libc::pause() };
    }
    let mut text = [0; 128];
    let mut rest = &mut text[..];
    let _ = match bytes {
        Some(bytes) => writeln!(rest, "globalsplat: the system refuses {bytes} bytes of memory"),
        None => writeln!(rest, "globalsplat: the system refuses memory"),
    };
    let left = rest.len();
    let length = text.len() - left;
    // SAFETY: the bytes are there, and the process ends without running anything that could need memory.
    unsafe {
        libc::write(2, text.as_ptr().cast(), length);
        libc::_exit(FAILED.into())
    }
}
