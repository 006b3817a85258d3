//! Memory that is asked for before those are called who don't bear that the system refuses it.

pub use ffi::*;

#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("room.h");

        /// See `csrc/room.h`.
        fn expect_room_for_code(bytes: i64) -> Result<()>;
    }
}
