//! The man pages.

use crate::book::{help, subcommands};
use crate::common::program::{arg, refuse, succeed};
use std::collections::BTreeSet;
use std::fs;

/// Appends the names of `command`, as in `["bench", "raster"]`, and of those below it.
fn append_commands(found: &mut Vec<Vec<String>>, command: &[String]) {
    for name in subcommands(&help(command)) {
        append_commands(found, &[command, &[name]].concat());
    }
    found.push(command.to_vec());
}

/// Returns the long options in a help text or in the source of a page, where dashes are escaped.
fn options(text: &str) -> BTreeSet<String> {
    let text = text.replace("\\-", "-");
    let starts = text.match_indices("--").map(|(at, _)| &text[at + 2..]);
    let names =
        starts.map(|rest| rest.split(|c: char| !c.is_ascii_alphanumeric() && c != '-').next().unwrap_or(""));
    names.filter(|name| name.starts_with(|c: char| c.is_ascii_lowercase())).map(String::from).collect()
}

#[test]
fn every_command_has_a_page_with_its_options() {
    let folder = tempfile::tempdir().unwrap();
    let pages = folder.path().join("share/man1");
    let report: serde_json::Value = serde_json::from_str(&succeed(&["man", arg(&pages), "--json"])).unwrap();
    let mut commands = vec![];
    append_commands(&mut commands, &[]);
    assert!(commands.len() > 20, "{commands:?}");
    let mut names = BTreeSet::new();
    for command in commands {
        let name = [&["globalsplat".to_string()][..], &command].concat().join("-") + ".1";
        let page = fs::read_to_string(pages.join(&name)).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(options(&page), options(&help(&command)), "{name}");
        assert!(command.is_empty() || page.contains(".SH EXAMPLES\n.nf\nglobalsplat "), "{name}:\n{page}");
        names.insert(name);
    }
    let written =
        fs::read_dir(&pages).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    assert_eq!(written.collect::<BTreeSet<_>>(), names);
    assert_eq!(report["pages"].as_array().unwrap().len(), names.len());
}

#[test]
fn a_folder_that_is_a_file_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("man1");
    fs::write(&file, "").unwrap();
    let message = refuse(&["man", arg(&file)]);
    assert!(message.contains("man1"), "{message}");
}
