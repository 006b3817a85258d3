//! Evaluation of rendered images: the methods and scenes under evaluation, validation, the paper's protocol over a dataset, and
//! its report.

mod baselines;
mod dataset;
mod evaluation;
mod index;
mod machine;
mod method;
mod photo_source;
mod published;
mod report;
mod scene;
mod score_store;
mod scores_file;
mod validation;

pub use baselines::Baselines;
pub use dataset::{DatasetEvaluation, weights_fingerprint};
pub use evaluation::{Efficiency, Evaluation, Failure, SceneScores, Summary};
pub use index::{EvaluationIndex, SceneFrames};
pub use machine::machine;
pub use method::{EvalImage, Method, MethodOutput, score_output};
pub use photo_source::LazyPhotos;
pub use published::{
    Published, PublishedAblation, PublishedCompactness, PublishedEfficiency, PublishedMethod,
    PublishedScores, published,
};
pub use report::{write_curves, write_report};
pub use scene::EvalScene;
pub use score_store::evaluation_files;
pub use scores_file::{REPORT, TABLE, comparison_path, read_evaluation, write_csv, write_evaluation};
pub use validation::{HeldOut, HeldOutScores};
