//! Gaussians and rays as tensors, and the camera geometry of the crate `globalsplat_capture`.
//!
//! All cameras use OpenCV axes: x right, y down, z forward. Poses are camera-to-world.

mod gaussians;
mod rays;

pub(crate) use gaussians::sigmoid;
pub use gaussians::{Gaussians, RawGaussians, splat_frame};
pub use globalsplat_capture::{
    Camera, ImageSize, Intrinsics, LocalFrame, Normalization, Similarity, Upright, estimate_upright, look_at,
    normalize, orbit_around_cameras, orbit_around_point, pose_to_rows, smooth_path,
};
pub(crate) use globalsplat_splat_file::SH_C0;
pub use rays::RadialWarp;
pub(crate) use rays::plucker_rays;
