//! Camera geometry: intrinsics and poses, normalization, local frames and camera paths.

mod camera;
mod local_frame;
mod normalize;
mod paths;

pub use camera::{Camera, ImageSize, Intrinsics, check_pose, nearest_rigid_of_scaled, pose_to_rows};
pub use local_frame::LocalFrame;
pub use normalize::{Normalization, Similarity, normalize};
pub use paths::{orbit_around_cameras, orbit_around_point, smooth_path};
