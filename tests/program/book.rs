//! Checks of the documentation: reference pages match the code, links resolve, and docs/SUMMARY.md lists every page.
//!
//! `GLOBALSPLAT_WRITE_REFERENCE=1 cargo test --release --test program book` writes the reference pages.

use globalsplat::config::Config;
use globalsplat::refine::RefineConfig;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Pages outside of `docs` and `crates`.
const OTHER_PAGES: [&str; 6] = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "models/README.md",
    "csrc/README.md",
    "csrc/cuda/README.md",
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: impl AsRef<Path>) -> String {
    let path = root().join(path);
    fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Compares a reference page with what the code gives, or writes it if the environment asks for that.
fn check_or_write(page: &str, expected: &str) {
    if std::env::var_os("GLOBALSPLAT_WRITE_REFERENCE").is_some() {
        fs::write(root().join(page), expected).expect("a file that can be written");
    }
    let advice = "run GLOBALSPLAT_WRITE_REFERENCE=1 cargo test --release --test program book";
    assert!(read(page) == expected, "{page} differs from what the code gives; {advice}");
}

/// Returns the help of a command, such as `["bench", "raster"]`.
pub fn help(command: &[String]) -> String {
    let output = Command::new(env!("CARGO_BIN_EXE_globalsplat"))
        .args(command)
        .arg("--help")
        // Help would otherwise wrap to the caller's terminal width.
        .env_remove("COLUMNS")
        .output()
        .expect("a program that starts");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "globalsplat {} --help: {errors}", command.join(" "));
    String::from_utf8(output.stdout).expect("text")
}

/// Returns the names in the list of commands of a help text, without `help`.
pub fn subcommands(help: &str) -> Vec<String> {
    let list = help.split("Commands:\n").nth(1).unwrap_or("").split("\n\n").next().unwrap_or("");
    let names = list.lines().filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    names
        .filter_map(|line| line.split_whitespace().next())
        .filter(|&name| name != "help")
        .map(String::from)
        .collect()
}

/// Appends a section for `command` and those for its subcommands.
fn append_command(page: &mut String, command: &[String]) {
    let text = help(command);
    let lines: Vec<&str> = text.trim_end().lines().map(str::trim_end).collect();
    let heading = "#".repeat(command.len().clamp(1, 2) + 1);
    page.push_str(&format!(
        "\n{heading} globalsplat {}\n\n```text\n{}\n```\n",
        command.join(" "),
        lines.join("\n")
    ));
    for name in subcommands(&text) {
        append_command(page, &[command, &[name]].concat());
    }
}

#[test]
fn commands_page_matches_help() {
    let mut page = String::from(
        "# Commands\n\nThe help of every command, as the program prints it. A test checks that this page is current.\n",
    );
    let names = subcommands(&help(&[]));
    assert!(names.len() > 10, "{names:?}");
    for name in names {
        append_command(&mut page, &[name]);
    }
    check_or_write("docs/commands.md", &page);
}

/// A key of a configuration, as its source documents it.
struct Key {
    name: String,
    text: String,
}

/// Returns the public fields of a struct in `source`, with their doc comments.
fn parse_keys(source: &str, name: &str) -> Vec<Key> {
    let body = source.split(&format!("pub struct {name} {{\n")).nth(1).expect("a struct");
    let (mut keys, mut text) = (vec![], String::new());
    for line in body.lines().map(str::trim).take_while(|line| *line != "}") {
        if let Some(more) = line.strip_prefix("///") {
            text = format!("{text} {}", more.trim());
        } else if let Some((field, _)) = line.strip_prefix("pub ").and_then(|field| field.split_once(':')) {
            keys.push(Key { name: field.into(), text: std::mem::take(&mut text).trim().into() });
        }
    }
    assert!(keys.iter().all(|key| !key.text.is_empty()), "{name}");
    keys
}

/// Returns a table of keys, each with its default in `defaults`.
fn table(keys: &[Key], defaults: &toml::Table) -> String {
    let mut lines = String::from("| key | default | description |\n|---|---|---|\n");
    for Key { name, text } in keys {
        let default = match defaults.get(name) {
            Some(toml::Value::Table(_)) => continue,
            Some(value) => format!("`{value}`"),
            None => "unset".into(),
        };
        // Links of the documentation to items lead nowhere in the book.
        let text = text.replace("[`", "`").replace("`]", "`").replace('|', "\\|");
        lines.push_str(&format!("| `{name}` | {default} | {text} |\n"));
    }
    lines
}

#[test]
fn configuration_page_matches_source() {
    let defaults: toml::Table = Config::default().to_toml().parse().expect("TOML");
    let section = |path: &[&str]| {
        path.iter().fold(&defaults, |table, name| table[*name].as_table().expect("a section")).clone()
    };
    let mut page = String::from(
        "# Configuration\n\nA configuration is a TOML file with these sections. Unknown keys are errors. `--set section.key=value` overrides a \
         key. The files in `configs/` are examples. A test checks that this page is current.\n",
    );
    for (path, file, name) in [
        (&["model"][..], "src/model/config.rs", "ModelConfig"),
        (&["data"], "src/data/config.rs", "DataConfig"),
        (&["data", "jitter"], "src/data/config.rs", "JitterConfig"),
        (&["curriculum"], "src/config/curriculum.rs", "CurriculumConfig"),
        (&["loss"], "src/loss/config.rs", "LossConfig"),
        (&["train"], "src/config/train.rs", "TrainConfig"),
    ] {
        page.push_str(&format!(
            "\n## [{}]\n\n{}",
            path.join("."),
            table(&parse_keys(&read(file), name), &section(path))
        ));
    }
    let refine = toml::Table::try_from(RefineConfig::default()).expect("plain values");
    page.push_str(&format!(
        "\n## refine\n\n`globalsplat refine --set key=value` changes these.\n\n{}",
        table(&parse_keys(&read("src/refine/config.rs"), "RefineConfig"), &refine)
    ));
    check_or_write("docs/configuration.md", &page);
}

/// Returns every page, relative to the repository's root.
fn pages() -> Vec<PathBuf> {
    let entries = |folder: &'static str| {
        let entries = fs::read_dir(root().join(folder)).expect("a folder");
        entries.map(move |entry| Path::new(folder).join(entry.expect("a file").file_name()))
    };
    let docs = entries("docs").filter(|path| path.extension().is_some_and(|ending| ending == "md"));
    let readmes = entries("crates").map(|folder| folder.join("README.md"));
    let readmes = readmes.filter(|page| root().join(page).is_file());
    docs.chain(readmes).chain(OTHER_PAGES.map(PathBuf::from)).collect()
}

/// Returns the anchors of a page's headings, as GitHub and mdBook make them.
fn anchors(text: &str) -> BTreeSet<String> {
    let (mut found, mut is_code) = (BTreeSet::new(), false);
    for line in text.lines() {
        is_code ^= line.starts_with("```");
        if let Some(title) = line.strip_prefix('#').filter(|_| !is_code) {
            let title = title.trim_start_matches('#').trim().to_lowercase();
            let kept = title.chars().filter(|&c| c.is_alphanumeric() || c == ' ' || c == '-' || c == '_');
            found.insert(kept.map(|c| if c == ' ' { '-' } else { c }).collect());
        }
    }
    found
}

/// Returns the targets of links and images that are not on the web.
fn links(text: &str) -> Vec<String> {
    let targets = text.match_indices("](").filter_map(|(at, _)| text[at + 2..].split(')').next());
    targets
        .filter(|target| !target.contains("://") && !target.contains(char::is_whitespace))
        .map(String::from)
        .collect()
}

#[test]
fn links_resolve() {
    let mut count = 0;
    for page in pages() {
        let text = read(&page);
        for link in links(&text) {
            let (file, anchor) =
                link.split_once('#').map_or((link.as_str(), None), |(file, anchor)| (file, Some(anchor)));
            let target =
                if file.is_empty() { page.clone() } else { page.parent().expect("a folder").join(file) };
            assert!(root().join(&target).exists(), "{}: there is no {link}", page.display());
            if let Some(anchor) = anchor {
                assert!(anchors(&read(&target)).contains(anchor), "{}: there is no {link}", page.display());
            }
            count += 1;
        }
    }
    assert!(count > 50, "{count} links: are all of them found?");
}

#[test]
fn the_book_lists_every_page() {
    let listed: BTreeSet<String> = links(&read("docs/SUMMARY.md")).into_iter().collect();
    let pages = pages();
    let docs =
        pages.iter().filter_map(|page| page.strip_prefix("docs").ok()).map(|page| page.display().to_string());
    let docs: BTreeSet<String> = docs.filter(|page| page != "SUMMARY.md").collect();
    assert_eq!(listed, docs);
}

/// README.md is an overview of at most 600 words.
#[test]
fn the_readme_has_600_words_at_most() {
    assert!(read("README.md").split_whitespace().count() <= 600);
}
