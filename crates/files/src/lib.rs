#![doc = include_str!("../README.md")]

mod append;
mod atomic;
mod checksum;
mod environment;
mod error;
mod inputs;
mod keyed_path;
mod program;
mod text;

pub use append::AppendFile;
pub use atomic::{
    PartialFile, check_regular, check_writable_dir, check_writable_file, parent_of, recover_dirs, remove_dir,
    replace_dir, write_atomically, write_json, write_temporary,
};
pub use checksum::checksum;
pub use environment::expand_path;
pub use error::{Error, Result, panic_message};
pub use inputs::InputFiles;
pub use keyed_path::split_keyed_path;
pub use program::is_program_missing;
pub use text::read_text;
