//! Descriptions of the command line for other programs: man pages and shell completions.

use super::{Cli, Output};
use crate::Error;
use crate::io::{check_writable_dir, write_atomically};
use anyhow::Result;
use clap::builder::Resettable;
use clap::{Args, Command, CommandFactory};
use clap_complete::Shell;
use clap_mangen::Man as Page;
use clap_mangen::roff::{Roff, roman};
use serde_json::json;
use std::io::{self, Write};
use std::path::PathBuf;

/// Print a script with which a shell completes the names of commands and options.
#[derive(Args)]
#[command(
    after_help = "Examples:\n  globalsplat completions bash > ~/.local/share/bash-completion/completions/globalsplat\n  \
    globalsplat completions zsh > ~/.zfunc/_globalsplat\n  \
    globalsplat completions fish > ~/.config/fish/completions/globalsplat.fish"
)]
pub struct Completions {
    /// Shell that reads the script
    #[arg(value_enum)]
    shell: Shell,
}

impl Completions {
    pub fn run(self) -> Result<Output> {
        let mut script = vec![];
        clap_complete::generate(self.shell, &mut Cli::command(), "globalsplat", &mut script);
        let script = String::from_utf8(script)?;
        Ok(Output::new(json!({ "script": script }), script.trim_end()))
    }
}

/// Write man pages: globalsplat.1, and one for every command, as in globalsplat-reconstruct.1.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat man ~/.local/share/man/man1\n  man globalsplat-reconstruct")]
pub struct Man {
    /// Folder for the pages; the folder above it belongs to the MANPATH
    #[arg(value_name = "DIR")]
    out: PathBuf,
}

impl Man {
    pub fn run(self) -> Result<Output> {
        check_writable_dir(&self.out)?;
        let mut program = Cli::command().disable_help_subcommand(true);
        program.build();
        let mut names = vec![];
        for command in visible_commands(&program) {
            let page = Page::new(command.clone().after_help(Resettable::Reset));
            let file = self.out.join(page.get_filename());
            write_atomically(&file, |writer| render(&page, command, writer).map_err(Error::write(&file)))?;
            names.push(page.get_filename());
        }
        let (out, count) = (self.out.to_string_lossy(), names.len());
        Ok(Output::new(json!({ "out": out, "pages": names }), format!("{out}: {count} pages")))
    }
}

/// Returns `command` and those below it, without what is hidden.
fn visible_commands(command: &Command) -> Vec<&Command> {
    let below = command.get_subcommands().filter(|command| !command.is_hide_set()).flat_map(visible_commands);
    std::iter::once(command).chain(below).collect()
}

/// Writes the page of `command`, whose examples clap_mangen would join to a paragraph under the heading EXTRA.
fn render(page: &Page, command: &Command, writer: &mut dyn Write) -> io::Result<()> {
    page.render(writer)?;
    let examples = command.get_after_help().map(ToString::to_string).unwrap_or_default();
    let mut roff = Roff::new();
    roff.control("SH", ["EXAMPLES"]).control("nf", []);
    examples.lines().skip(1).for_each(|line| {
        roff.text([roman(line.trim_start())]);
    });
    roff.control("fi", []).to_writer(writer)
}
