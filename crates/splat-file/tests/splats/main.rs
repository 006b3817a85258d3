//! Tests of every format: its bytes, what is lost in it, and invalid files.

mod common;
mod gltf;
mod invalid_files;
mod ksplat;
mod round_trips;
mod sog;
mod spz;
mod values;
