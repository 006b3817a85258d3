//! Camera geometry: intrinsics and poses, normalization, local frames, camera paths, and upright and metric worlds.

mod align;
mod camera;
mod eigen;
mod local_frame;
mod normalize;
mod paths;
mod upright;

pub use align::{PositionFit, fit_positions};
pub use camera::{Camera, ImageSize, Intrinsics, check_pose, look_at, nearest_rigid_of_scaled, pose_to_rows};
pub use local_frame::LocalFrame;
pub use normalize::{Normalization, Similarity, normalize};
pub use paths::{orbit_around_cameras, orbit_around_point, smooth_path};
pub use upright::{UpSource, Upright, estimate_upright};
