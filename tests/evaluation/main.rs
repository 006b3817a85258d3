//! Tests of what follows training: reconstruction at other sizes and places, refinement, evaluation, the report.

#[path = "../common/mod.rs"]
mod common;

mod colour_fit;
mod evaluation;
mod high_resolution;
mod refine;
mod report;
