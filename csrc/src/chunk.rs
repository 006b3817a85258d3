//! Pickling of RealEstate10K-style chunks.

pub use ffi::*;

#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    /// Encoded contents of an image file.
    #[derive(Debug, Clone)]
    struct EncodedImage {
        /// Bytes of the file.
        bytes: Vec<u8>,
    }

    /// Posed video with equally many timestamps, cameras and images: one for each view.
    #[derive(Debug, Clone)]
    struct SceneToPickle {
        /// Key of the scene in an index.
        key: String,
        /// Source of the video; may be empty.
        url: String,
        /// Timestamps in microseconds.
        timestamps: Vec<i64>,
        /// Camera parameters, 18 values per view: f_x, f_y, c_x, c_y relative to the width and height, 0, 0, and the first three rows of
        /// w2c.
        cameras: Vec<f32>,
        /// Images, one for each camera.
        images: Vec<EncodedImage>,
    }

    unsafe extern "C++" {
        include!("chunk.h");

        /// Serializes scenes in the format of torch.save; see `csrc/chunk.h`.
        fn pickle_scenes(scenes: &Vec<SceneToPickle>) -> Result<UniquePtr<CxxVector<u8>>>;
    }
}
