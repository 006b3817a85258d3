//! Tests of the program: every command, every kind of bad input, every output, on the CPU and with emulated kernels for GPUs.

#[path = "../common/mod.rs"]
mod common;

mod bad_formats;
mod bad_input;
mod book;
mod commands;
mod cuda;
mod examples;
mod film;
mod outputs;
mod paths;
mod quality;
