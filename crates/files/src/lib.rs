#![doc = include_str!("../README.md")]

mod append;
mod archive;
mod atomic;
mod error;
mod inputs;
mod lock;
mod paths;
mod read;

pub use append::AppendFile;
pub use archive::stored_zip;
pub use atomic::{
    PartialFile, check_regular, check_writable_dir, check_writable_file, parent_of, replace_link, sync_dir,
    write_atomically, write_file, write_files, write_json, write_temporary,
};
pub use error::{Error, Result, is_program_missing, panic_message};
pub use inputs::{InputFiles, is_same_file, real_path};
pub use lock::FolderLock;
pub use paths::{expand_path, relative_name, split_keyed_path};
pub use read::{checksum, read_text};
