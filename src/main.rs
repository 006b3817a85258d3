//! The `globalsplat` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    globalsplat::main()
}
