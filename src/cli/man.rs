//! Descriptions of the command line for other programs: man pages and shell completions.

use super::{command_line, print_json};
use crate::Error;
use crate::io::{check_writable_dir, write_atomically};
use anyhow::Result;
use clap::{Args, Command};
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
    pub fn run(self) -> Result<()> {
        let mut script = vec![];
        clap_complete::generate(self.shell, &mut command_line(), "globalsplat", &mut script);
        print!("{}", String::from_utf8(script)?);
        Ok(())
    }
}

/// Write man pages: globalsplat.1, and one for every command, as in globalsplat-reconstruct.1.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat man ~/.local/share/man/man1\n  man globalsplat-reconstruct")]
pub struct Man {
    /// Folder for the pages; the folder above it belongs to the MANPATH
    #[arg(value_name = "DIR")]
    out: PathBuf,
    /// Print the names of the pages as one JSON object
    #[arg(long)]
    json: bool,
}

impl Man {
    pub fn run(self) -> Result<()> {
        check_writable_dir(&self.out)?;
        let mut program = command_line().disable_help_subcommand(true);
        program.build();
        let source = format!("globalsplat {}", env!("CARGO_PKG_VERSION"));
        let mut names = vec![];
        for command in visible_commands(&program) {
            let page = Page::new(command.clone()).source(&source);
            let file = self.out.join(page.get_filename());
            write_atomically(&file, |writer| render(&page, command, writer).map_err(Error::write(&file)))?;
            names.push(page.get_filename());
        }
        if self.json {
            print_json(&json!({ "out": self.out.to_string_lossy(), "pages": names }));
        } else {
            println!("{}: {} pages", self.out.display(), names.len());
        }
        Ok(())
    }
}

/// Returns `command` and those below it, without what is hidden.
fn visible_commands(command: &Command) -> Vec<&Command> {
    let below = command.get_subcommands().filter(|command| !command.is_hide_set()).flat_map(visible_commands);
    std::iter::once(command).chain(below).collect()
}

/// Writes the page of `command`.
fn render(page: &Page, command: &Command, writer: &mut dyn Write) -> io::Result<()> {
    page.render_title(writer)?;
    page.render_name_section(writer)?;
    page.render_synopsis_section(writer)?;
    page.render_description_section(writer)?;
    page.render_options_section(writer)?;
    if command.has_subcommands() {
        page.render_subcommands_section(writer)?;
    }
    // clap_mangen would join the lines of the examples to a paragraph under the heading EXTRA.
    if let Some(examples) = command.get_after_help() {
        let mut roff = Roff::new();
        roff.control("SH", ["EXAMPLES"]).control("nf", []);
        examples.to_string().lines().skip(1).for_each(|line| {
            roff.text([roman(line.trim_start())]);
        });
        roff.control("fi", []).to_writer(writer)?;
    }
    Ok(())
}
