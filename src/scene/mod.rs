//! Camera maths: intrinsics and poses, scene normalization, rays, trajectories.
//!
//! OpenCV axes everywhere: x right, y down, z forward. Poses are camera-to-world.

mod camera;
mod normalize;
mod rays;
mod trajectory;

pub use camera::{Camera, Intrinsics, check_pose, nearest_rigid, pose_to_rows};
pub use normalize::{Normalization, Similarity, normalize};
pub use rays::plucker_rays;
pub use trajectory::{orbit_around_cameras, orbit_around_point};
