//! Memory that the system refuses, as under `ulimit -v`: one sentence and exit code 1, as for all work that fails.

use super::FAILED;
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
        end(bytes);
    }
    memory
}

/// Has the process end with exit code 1 where a library below aborts it, which it does for want of memory, glibc with a sentence
/// of its own.
pub fn end_instead_of_aborting() {
    extern "C" fn end(_: libc::c_int) {
        // SAFETY: ends the process, which is allowed in a signal's handler.
        unsafe { libc::_exit(FAILED.into()) }
    }
    // SAFETY: the handler does nothing that a handler may not.
    unsafe { libc::signal(libc::SIGABRT, end as extern "C" fn(libc::c_int) as libc::sighandler_t) };
}

/// Says so without taking memory for it.
#[cold]
fn end(bytes: usize) -> ! {
    use std::io::Write;
    let mut text = [0; 128];
    let mut rest = &mut text[..];
    let _ = writeln!(rest, "globalsplat: the system refuses {bytes} bytes of memory");
    let left = rest.len();
    let length = text.len() - left;
    // SAFETY: the bytes are there, and the process ends without running anything that could need memory.
    unsafe {
        libc::write(2, text.as_ptr().cast(), length);
        libc::_exit(FAILED.into())
    }
}
