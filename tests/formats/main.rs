//! Tests of files in and out: captures, chunks, synthetic videos and splats of every format, units and origins.

#[path = "../common/mod.rs"]
mod common;

mod captures;
mod chunks;
mod splats;
mod synth;
mod units_and_origin;
