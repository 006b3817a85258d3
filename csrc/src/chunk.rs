//! Pickles of RealEstate10K-style chunks.

pub use ffi::*;

#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    /// The bytes of an image file.
    #[derive(Debug, Clone)]
    struct EncodedImage {
        /// As they are in the file.
        bytes: Vec<u8>,
    }

    /// A posed video: as many timestamps, cameras and images as it has views.
    #[derive(Debug, Clone)]
    struct SceneToPickle {
        /// By which an index names the scene.
        key: String,
        /// Where the video came from; may be empty.
        url: String,
        /// Microseconds.
        timestamps: Vec<i64>,
        /// 18 numbers of each view: f_x, f_y, c_x, c_y of the width and height, 0, 0, and w2c's first three rows.
        cameras: Vec<f32>,
        /// As many as cameras.
        images: Vec<EncodedImage>,
    }

    unsafe extern "C++" {
        include!("chunk.h");

        /// See `csrc/chunk.h`.
        fn pickle_scenes(scenes: &Vec<SceneToPickle>) -> Result<UniquePtr<CxxVector<u8>>>;
    }
}
