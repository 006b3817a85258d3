//! Tests of the interactive page and of other viewers, in a browser.

#[path = "../common/mod.rs"]
mod common;

mod view;
mod viewers;
