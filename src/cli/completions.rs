use super::command_line;
use anyhow::Result;
use clap::{Args, Command};
use clap_complete::Shell;

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
        clap_complete::generate(self.shell, &mut without_hidden(&command_line()), "globalsplat", &mut script);
        print!("{}", String::from_utf8(script)?);
        Ok(())
    }
}

/// Returns what `command` shows in its help. clap_complete also completes what is hidden.
fn without_hidden(command: &Command) -> Command {
    let visible = Command::new(command.get_name().to_string())
        .args(command.get_arguments().filter(|argument| !argument.is_hide_set()))
        .subcommands(command.get_subcommands().filter(|command| !command.is_hide_set()).map(without_hidden))
        .propagate_version(true);
    let visible = match command.get_version() {
        Some(version) => visible.version(version.to_string()),
        None => visible,
    };
    match command.get_about() {
        Some(about) => visible.about(about.clone()),
        None => visible,
    }
}
