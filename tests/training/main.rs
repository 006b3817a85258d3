//! Tests of training: configurations, runs and their resumption, several processes.

#[path = "../common/mod.rs"]
mod common;

mod configs;
mod distributed;
mod runs;
