//! Depths of photos by a plane sweep, which needs no weights: for every pixel, the depth at which photos taken from other positions look
//! most alike.

mod consistency;
mod depth_map;
pub(crate) mod depth_search;
mod pixel_depths;
mod small_photo;
mod sweep;
mod view_selection;

pub use depth_map::DepthMap;

// Used by the refinement, which starts from depths, and by the photos of a model that reads depths.
pub(crate) use depth_map::{numbers, truths};
pub(crate) use pixel_depths::pixel_depths;
pub(crate) use small_photo::{SmallPhoto, pool_masked};
pub(crate) use sweep::{PlaneSweepOutput, SWEEP_SIDE, sweep};
pub(crate) use view_selection::{are_near_duplicates, nearest_to, projection};
