//! Pickles of RealEstate10K-style chunks.

pub use ffi::*;

#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    /// A part of a file.
    #[derive(Debug, Clone, Copy)]
    struct ByteRange {
        /// In bytes.
        start: u64,
        /// In bytes.
        length: u64,
    }

    /// A tensor's bytes in an archive.
    #[derive(Debug, Clone)]
    struct ChunkRecord {
        /// By which the pickle asks for it.
        key: String,
        /// In the file.
        start: u64,
        /// In bytes.
        length: u64,
    }

    /// A posed video in a chunk: as many timestamps, cameras and images as it has views.
    #[derive(Debug, Clone)]
    struct ChunkScene {
        /// By which an index names the scene.
        key: String,
        /// Where the video came from; may be empty.
        url: String,
        /// Microseconds.
        timestamps: Vec<i64>,
        /// 18 numbers of each view: f_x, f_y, c_x, c_y of the width and height, 0, 0, and w2c's first three rows.
        cameras: Vec<f32>,
        /// Where each encoded image lies in the file.
        images: Vec<ByteRange>,
    }

    /// The bytes of an image file.
    #[derive(Debug, Clone)]
    struct EncodedImage {
        /// As they are in the file.
        bytes: Vec<u8>,
    }

    /// As [`ChunkScene`], with the images themselves.
    #[derive(Debug, Clone)]
    struct SceneToPickle {
        /// As there.
        key: String,
        /// As there.
        url: String,
        /// As there.
        timestamps: Vec<i64>,
        /// As there.
        cameras: Vec<f32>,
        /// As many as cameras.
        images: Vec<EncodedImage>,
    }

    unsafe extern "C++" {
        include!("chunk.h");

        /// See `csrc/chunk.h`.
        fn unpickle_scenes(file: &[u8], pickle: &[u8], records: &Vec<ChunkRecord>)
        -> Result<Vec<ChunkScene>>;

        /// See `csrc/chunk.h`.
        fn pickle_scenes(scenes: &Vec<SceneToPickle>) -> Result<UniquePtr<CxxVector<u8>>>;
    }
}
