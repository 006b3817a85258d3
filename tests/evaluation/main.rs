//! Tests of what follows training: reconstruction at other sizes and places, refinement, evaluation, the report.

#[path = "../common/mod.rs"]
mod common;

mod color_fit;
mod evaluation;
mod refine;
mod report;
