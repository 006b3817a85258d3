//! Fuzz target of every reader: the environment variable `FUZZ_READER` selects one by its name.
#![no_main]

#[path = "../../tests/common/readers.rs"]
mod readers;

use std::sync::OnceLock;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    static READER: OnceLock<readers::Reader> = OnceLock::new();
    let find = || {
        let name = std::env::var("FUZZ_READER").expect("FUZZ_READER is set");
        readers::READERS.iter().find(|(reader, _)| *reader == name).expect("a reader of that name").1
    };
    READER.get_or_init(find)(bytes);
});
