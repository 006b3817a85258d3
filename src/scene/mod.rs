//! Scene representation (cameras and Gaussians) and camera maths: intrinsics and poses, normalization, rays, trajectories.
//!
//! All cameras use OpenCV axes: x right, y down, z forward. Poses are camera-to-world.

mod camera;
mod gaussians;
mod local_frame;
mod normalize;
mod rays;
mod smooth_path;
mod trajectory;

pub use camera::{Camera, ImageSize, Intrinsics, pose_to_rows};
pub(crate) use camera::{check_pose, nearest_rigid_of_scaled};
pub use gaussians::{Gaussians, RawGaussians};
pub(crate) use gaussians::{MIN_SCALE, SH_C0, sigmoid};
pub use local_frame::LocalFrame;
pub use normalize::{Normalization, Placement, Similarity, normalize};
pub(crate) use rays::plucker_rays;
pub use smooth_path::smooth_path;
pub use trajectory::{orbit_around_cameras, orbit_around_point};
