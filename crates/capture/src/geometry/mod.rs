//! Camera geometry: intrinsics and poses, normalization, local frames and camera paths.

mod camera;
mod local_frame;
mod normalize;
mod smooth_path;
mod trajectory;

pub use camera::{Camera, ImageSize, Intrinsics, check_pose, nearest_rigid_of_scaled, pose_to_rows};
pub use local_frame::LocalFrame;
pub use normalize::{Normalization, Similarity, normalize};
pub use smooth_path::smooth_path;
pub use trajectory::{orbit_around_cameras, orbit_around_point};
