//! Using a model and judging pictures: reconstruction, metrics, the protocol, and pictures to look at.

mod contact_sheet;
mod evaluation;
mod held_out;
mod index;
mod machine;
mod memory;
mod metrics;
mod perceptual;
mod protocol;
mod published;
mod reconstruct;
mod report;
mod scores_file;
mod strip;
mod sweep;

pub use contact_sheet::contact_sheet;
pub use evaluation::{Efficiency, Evaluation, Failure, SceneScores, Summary, scene_file_name};
pub use held_out::{HeldOut, HeldOutScores};
pub use index::{EvaluationIndex, SceneFrames};
pub use machine::machine;
pub use memory::{device_memory_bytes, peak_memory_bytes, resident_memory_bytes};
pub use metrics::{psnr, ssim};
pub use perceptual::Perceptual;
pub use protocol::{
    CaptureScores, Rendered, ViewScore, render_views, score, score_model, score_renders, score_splat,
};
pub use published::{
    Published, PublishedAblation, PublishedCompactness, PublishedEfficiency, PublishedMethod,
    PublishedScores, published,
};
pub use reconstruct::{Model, Reconstruction, reconstruct};
pub use report::write_report;
pub use scores_file::{read_evaluation, strip_path, write_csv, write_evaluation};
pub use sweep::{Subject, Sweep};
