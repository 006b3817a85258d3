//! Files: splats (PLY), weights (safetensors), images, films and TensorBoard's events. Writing never leaves half a file.

mod append;
mod atomic;
mod event_file;
mod film;
mod images;
mod model_file;
mod ply;
mod pretrained;
mod weights;

pub use append::AppendFile;
pub use atomic::{check_writable_dir, check_writable_file, recover_dirs, replace_dir, write_atomically};
pub use event_file::EventFile;
pub use film::write_film;
pub use images::{
    Photo, colourize_depth, decode_photo, encode_photo, encoded_image_size, enlarge, read_image,
    read_image_size, tensor_from_rgb, tile_horizontally, tile_vertically, write_jpeg, write_png,
};
pub use model_file::{CONFIG_KEY, LoadedModel, ModelDtype, load_model, save_model};
pub use ply::{Ply, ply_size, read_ply, write_ply};
pub use pretrained::{WEIGHTS_VARIABLE, find_pretrained, pretrained_folders};
pub use weights::{Weights, read_weights, write_weights};
