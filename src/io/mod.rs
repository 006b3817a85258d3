//! File formats: splats, weights (safetensors), images, videos and TensorBoard event files. Files appear complete or not at all.

mod event_file;
mod html;
mod images;
mod splat;
mod video;
mod weights;

/// Name of the file that has a training run's configuration, with every key written out.
pub const CONFIG_FILE: &str = "config.toml";
/// Name of the metrics file of a run, which has one line for every step and every validation.
pub const METRICS_FILE: &str = "metrics.jsonl";

pub use globalsplat_files::{
    InputFiles, check_regular, check_writable_dir, check_writable_file, checksum, parent_of,
    write_atomically, write_file,
};
pub use globalsplat_splat_file::{
    ShLimits, Splat, WriteOptions, check_writable_splat, find_splat, is_splat_name, origin_file,
    output_format, read_splat, read_splat_without_invalid, splat_files, write_local_splat, write_splat,
};

pub use globalsplat_capture::{decode_photo, encode_photo, read_image};
pub use html::html_page;
pub use images::{
    Mosaic, check_writable_png, is_png_name, jpeg_data_url, rgb_from_tensor, tensor_from_rgb,
    tile_horizontally, tiled_size, write_png,
};
pub use splat::{fit_splat, rounding_warning};
pub use video::{VideoWriter, find_ffmpeg};
pub use weights::{
    WEIGHTS_VARIABLE, Weights, WeightsFile, find_pretrained, is_weights_name, read_weights, write_checkpoint,
    write_weights,
};

pub(crate) use globalsplat_files::{
    AppendFile, FolderLock, expand_path, read_text, real_path, relative_name, replace_link, sync_dir,
    write_json,
};

pub(crate) use event_file::{EventFile, event_files};
pub(crate) use globalsplat_capture::{PHOTO_EXTENSIONS, read_image_size};
pub(crate) use images::{enlarge, shrink, shrink_factor, subsample, write_jpeg};
pub(crate) use weights::pretrained_folders;
