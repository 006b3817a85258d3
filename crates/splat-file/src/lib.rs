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
    RoundSh, WriteOptions, can_mark_antialiased, check_writable_splat, find_splat, is_splat_name, limits_of,
    read_splat, read_splat_without_invalid, sh_rounding_of, splat_files, write_local_splat,
    write_local_splat_with, write_splat,
};
pub use globalsplat_files::{Error, Result};
pub use limits::ShLimits;
pub use origin::{check_writable_origin, origin_file};
pub use sh::ShRotation;
pub use splat::{MIN_SCALE, OPACITY_MARGIN, SH_C0, Splat};
