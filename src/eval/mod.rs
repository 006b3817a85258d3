//! Evaluation of rendered images: the methods and scenes under evaluation, validation, the paper's protocol over a dataset, and its report.

mod dataset;
mod depths;
mod evaluation;
mod method;
mod published;
mod report;
mod scene;
mod validation;

pub use dataset::{DatasetEvaluation, evaluation_files, weights_fingerprint};
pub use evaluation::{
    Efficiency, Evaluation, Failure, REPORT, SceneScores, Summary, comparison_path, read_evaluation,
    write_evaluation,
};
pub use method::Method;
pub use report::write_report;
pub use scene::{EvalScene, EvaluationIndex, SceneFrames};
pub use validation::{HeldOut, HeldOutScores};
