//! Evaluation of rendered images: metrics, the methods and scenes under evaluation, validation, the paper's protocol over a dataset, and
//! its report.

mod age;
mod comparison_image;
mod contact_sheet;
mod evaluation;
mod fidelity;
mod held_out;
mod index;
mod machine;
mod method;
mod metrics;
mod perceptual;
mod photo_source;
mod published;
mod report;
mod scene;
mod score_store;
mod score_views;
mod scores;
mod scores_file;
mod sweep;

pub use age::process_age;
pub use contact_sheet::ContactSheet;
pub use evaluation::{Efficiency, Evaluation, Failure, SceneScores, Summary};
pub use fidelity::psnr_between;
pub use held_out::{HeldOut, HeldOutScores};
pub use index::{EvaluationIndex, SceneFrames};
pub use machine::machine;
pub use method::{EvalImage, Method, MethodOutput, score_output, score_with_lpips};
pub use metrics::{masked_psnr, masked_ssim, psnr, ssim};
pub use perceptual::Perceptual;
pub use photo_source::LazyPhotos;
pub use published::{
    Published, PublishedAblation, PublishedCompactness, PublishedEfficiency, PublishedMethod,
    PublishedScores, published,
};
pub use report::{write_curves, write_report};
pub use scene::EvalScene;
pub use score_store::evaluation_files;
pub use score_views::score_views;
pub use scores::{Baselines, CaptureScores, ViewScore, score};
pub use scores_file::{REPORT, TABLE, comparison_path, read_evaluation, write_csv, write_evaluation};
pub use sweep::{DatasetEvaluation, weights_fingerprint};
