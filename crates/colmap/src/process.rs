//! Runs COLMAP and ffmpeg, reads what they print by line, and kills them if the work ends early.

use globalsplat_files::{Error, Result};
use std::io::{self, BufRead, BufReader, pipe};
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

/// Maximum time between two calls of the function that watches a process.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// A running program. It is killed on drop unless it has ended.
pub(crate) struct Process {
    child: Child,
    /// Lines that it prints, without white space at their ends.
    lines: Receiver<String>,
}

impl Process {
    /// Starts a program whose standard error is read as lines, and so is its standard output unless that `is_data`.
    pub fn start(mut command: Command, is_data: bool) -> io::Result<Self> {
        let (reader, writer) = pipe()?;
        let stdout = if is_data { Stdio::piped() } else { writer.try_clone()?.into() };
        let child = command.stdout(stdout).stderr(writer).spawn()?;
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            let lines = BufReader::new(reader).split(b'\n').map_while(io::Result::ok);
            // Nobody listens any more after a stop.
            lines.for_each(|line| drop(sender.send(String::from_utf8_lossy(&line).trim_end().to_string())));
        });
        Ok(Process { child, lines })
    }

    /// Takes the standard output of a program that was started to print data.
    pub fn take_output(&mut self) -> BufReader<ChildStdout> {
        BufReader::new(self.child.stdout.take().expect("a pipe was requested, and not taken yet"))
    }

    /// Waits for the end of the program. Calls `watch` with each line that it prints, and regularly with `None` in between; the program is
    /// killed if `watch` fails.
    ///
    /// # Errors
    /// Returns the error of `watch`.
    pub fn wait(mut self, mut watch: impl FnMut(Option<String>) -> Result<()>) -> Result<ExitStatus> {
        loop {
            match self.lines.recv_timeout(POLL_INTERVAL) {
                Ok(line) => watch(Some(line))?,
                Err(RecvTimeoutError::Timeout) => watch(None)?,
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        self.child.wait().map_err(Error::failed_with_context("the end of a process is unknown"))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
