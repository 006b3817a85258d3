//! Tests of training: configurations, runs and their resumption, several processes, the live page.

#[path = "../common/mod.rs"]
mod common;

mod configs;
mod distributed;
mod runs;
mod watch;
