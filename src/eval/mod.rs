//! Using a model and judging pictures: reconstruction, metrics, the protocol, and pictures to look at.

mod contact_sheet;
mod evaluation;
mod memory;
mod metrics;
mod perceptual;
mod protocol;
mod reconstruct;

pub use contact_sheet::contact_sheet;
pub use evaluation::{Efficiency, Evaluation, Failure, SceneScores, Summary};
pub use memory::{peak_memory_bytes, resident_memory_bytes};
pub use metrics::{psnr, ssim};
pub use perceptual::Perceptual;
pub use protocol::{
    CaptureScores, Rendered, ViewScore, nearest_context_baseline, render_views, score, score_model,
    score_renders, score_splat,
};
pub use reconstruct::{Reconstruction, reconstruct};
