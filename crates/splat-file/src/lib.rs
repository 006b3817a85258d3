#![doc = include_str!("../README.md")]

mod axes;
mod compressed_ply;
mod dot_splat;
mod formats;
mod gltf;
mod invalid;
mod ksplat;
mod limits;
mod morton;
mod numbers;
mod origin;
mod ply;
mod ply_table;
mod rotations;
mod sh;
mod sog;
mod splat;
mod spz;
mod transform;

pub use formats::{
    SplatFormat, WriteOptions, check_writable_splat, find_splat, is_splat_name, output_format, read_splat,
    read_splat_without_invalid, splat_files, write_local_splat, write_splat,
};
pub use globalsplat_files::{Error, Result};
pub use limits::ShLimits;
pub use origin::origin_file;
pub use sh::{ShRotation, sh_basis};
pub use splat::{MIN_SCALE, OPACITY_MARGIN, SH_C0, Splat};
