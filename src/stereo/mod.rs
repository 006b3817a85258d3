//! Depths of photos by a plane sweep, which needs no weights: for every pixel, the depth at which photos taken from other positions look
//! most alike.

mod agreement;
mod coverage;
pub(crate) mod depth_search;
mod pixel_depths;
mod sweep;
mod view_selection;

pub use sweep::DepthMap;

// Used by the refinement, which starts from depths, and by the photos of a model that reads depths.
pub(crate) use agreement::{Agreement, ComparablePhoto, PhotoSurface};
pub(crate) use coverage::covered;
pub(crate) use depth_search::{SmallPhoto, pool_masked};
pub(crate) use pixel_depths::pixel_depths;
pub(crate) use sweep::{PlaneSweepOutput, SWEEP_SIDE, numbers, sweep, truths};
pub(crate) use view_selection::{
    are_near_duplicates, nearest_first, nearest_to, pixel_and_depth, projection,
};
