//! Checks of the documentation: docs/configuration.md matches the code, and links resolve.
//!
//! `GLOBALSPLAT_WRITE_REFERENCE=1 cargo test --release --test program book` writes docs/configuration.md.

use globalsplat::config::Config;
use globalsplat::refine::RefineOptions;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

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

/// A key of a configuration, as its source documents it.
struct Key {
    name: String,
    text: String,
}

/// Returns the public fields of a struct after the line `opening` of `source`, with their doc comments.
fn parse_keys(source: &str, opening: &str) -> Vec<Key> {
    let body = source.split(opening).nth(1).expect("a struct");
    let (mut keys, mut text) = (vec![], String::new());
    for line in body.lines().map(str::trim).take_while(|line| *line != "}") {
        if let Some(more) = line.strip_prefix("///") {
            text = format!("{text} {}", more.trim());
        } else if let Some((field, _)) = line.strip_prefix("pub ").and_then(|field| field.split_once(':')) {
            keys.push(Key { name: field.into(), text: std::mem::take(&mut text).trim().into() });
        }
    }
    assert!(keys.iter().all(|key| !key.text.is_empty()), "{opening}");
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
        (&["curriculum"], "src/config/train.rs", "CurriculumConfig"),
        (&["loss"], "src/loss/config.rs", "LossConfig"),
        (&["train"], "src/config/train.rs", "TrainConfig"),
    ] {
        page.push_str(&format!(
            "\n## [{}]\n\n{}",
            path.join("."),
            table(&parse_keys(&read(file), &format!("pub struct {name} {{\n")), &section(path))
        ));
    }
    let refine = toml::Table::try_from(RefineOptions::default()).expect("plain values");
    page.push_str(&format!(
        "\n## refine\n\n`globalsplat refine --set key=value` changes these.\n\n{}",
        table(&parse_keys(&read("src/refine/options.rs"), "\n        both:\n"), &refine)
    ));
    let file = "docs/configuration.md";
    if std::env::var_os("GLOBALSPLAT_WRITE_REFERENCE").is_some() {
        fs::write(root().join(file), &page).expect("a file that can be written");
    }
    let advice = "run GLOBALSPLAT_WRITE_REFERENCE=1 cargo test --release --test program book";
    assert!(read(file) == page, "{file} differs from what the code gives; {advice}");
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
        }
    }
}
