//! Evaluation of rendered images: the methods and scenes under evaluation, validation, the paper's protocol over a dataset, and its report.

mod dataset;
mod evaluation;
mod method;
mod published;
mod report;
mod scene;
mod validation;

pub use dataset::{DatasetEvaluation, evaluation_files, weights_fingerprint};
pub use evaluation::{
    Efficiency, Evaluation, Failure, REPORT, SceneScores, Summary, TABLE, comparison_path, machine,
    read_evaluation, write_csv, write_evaluation,
};
pub use method::{Baselines, EvalImage, Method, MethodOutput, score_output};
pub use published::{
    Published, PublishedAblation, PublishedCompactness, PublishedEfficiency, PublishedMethod,
    PublishedScores, published,
};
pub use report::{write_curves, write_report};
pub use scene::{EvalScene, EvaluationIndex, LazyPhotos, SceneFrames};
pub use validation::{HeldOut, HeldOutScores};
