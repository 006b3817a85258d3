//! File formats: splats, weights (safetensors), images, videos, arrays (NPY) and TensorBoard event files. Writes never leave a partial
//! file.

mod depth_colours;
mod dtype;
mod edit;
mod event_file;
mod images;
mod mosaic;
mod neighbours;
mod npy;
mod pretrained;
mod shards;
mod splat;
mod state_dict;
mod video;
mod weights;
mod weights_file;

/// Name of the file that has a training run's configuration, with every key written out.
pub const CONFIG_FILE: &str = "config.toml";
/// Name of the metrics file of a run, which has one line for every step and every validation.
pub const METRICS_FILE: &str = "metrics.jsonl";

pub use globalsplat_files::{
    InputFiles, check_regular, check_writable_dir, check_writable_file, checksum, parent_of, write_atomically,
};
pub use globalsplat_splat_file::{
    ShLimits, Splat, WriteOptions, can_mark_antialiased, check_writable_origin, check_writable_splat,
    find_splat, is_splat_name, limits_of, origin_file, read_splat, read_splat_without_invalid, splat_files,
    write_local_splat, write_local_splat_with, write_splat,
};

pub use depth_colours::{DepthScale, colourize_depth, depth_colours};
pub use edit::{EditedSplat, SplatEdit, edit_splat, move_cameras};
pub use globalsplat_capture::{decode_photo, encode_photo, read_image};
pub use images::{
    check_writable_png, is_png_name, rgb_from_tensor, tensor_from_rgb, tile_horizontally, tile_vertically,
    tiled_size, write_png,
};
pub use mosaic::Mosaic;
pub use npy::write_npy;
pub use pretrained::{WEIGHTS_VARIABLE, find_pretrained};
pub use shards::{shard_index, write_sharded};
pub use splat::{fit_splat, rounding_warning};
pub use video::{VideoWriter, find_ffmpeg};
pub use weights::{Weights, write_checkpoint, write_weights};
pub use weights_file::{MappedWeights, WeightsFile, is_weights_name, read_weights, weights_files};

pub(crate) use globalsplat_files::{
    AppendFile, expand_path, read_text, recover_dirs, remove_dir, replace_dir, write_json,
};

pub(crate) use event_file::{EventFile, event_files};
pub(crate) use globalsplat_capture::{PHOTO_EXTENSIONS, read_image_size};
pub(crate) use images::{enlarge, shrink, subsample, write_jpeg};
pub(crate) use mosaic::shrink_factor;
pub(crate) use pretrained::pretrained_folders;
