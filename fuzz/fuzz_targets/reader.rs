//! Fuzz target that every fuzz binary shares: the name of the binary selects the reader.
#![no_main]

#[path = "../../tests/common/readers/mod.rs"]
#[allow(dead_code)] // every target uses only one
mod readers;

use std::sync::OnceLock;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    static READER: OnceLock<readers::Reader> = OnceLock::new();
    let named = || readers::READERS.iter().find(|(name, _)| *name == env!("CARGO_BIN_NAME"));
    READER.get_or_init(|| named().expect("a reader of that name").1)(bytes);
});
