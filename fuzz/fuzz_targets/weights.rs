#![no_main]

#[path = "../../tests/common/readers.rs"]
#[allow(dead_code)] // every target uses one
mod readers;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| readers::weights(bytes));
