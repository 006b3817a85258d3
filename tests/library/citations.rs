//! Every citation of the specification, docs/spec.md, refers to an existing section.
//!
//! A citation is on one line: the word `spec`, a space, and the number of a section, `N` or `N.M`; after a comma, `and` or `to`
//! may follow further numbers. So `spec 3.1`, `Spec 3`, `spec 3.1 and 3.2`, `spec 3 to 5` and `spec 7.3, 7.5 and 7.6` are
//! citations. For `to` both ends are looked up: the sections between them exist, as sections are numbered without gaps.

use std::fs;
use std::path::{Path, PathBuf};

/// Files and folders that may cite the specification, relative to the repository's root.
const PLACES: [&str; 8] = ["src", "csrc", "parity", "tests", "configs", "scripts", "docs", "README.md"];
/// Further such files and folders, which need not exist.
const OPTIONAL_PLACES: [&str; 2] = ["examples", "CONTRIBUTING.md"];
const SPECIFICATION: &str = "docs/spec.md";
/// Path of this file, whose examples cite sections that don't exist.
const THIS_FILE: &str = "tests/library/citations.rs";
/// Minimum number of citations outside of the specification; fewer mean that the search is broken.
const LEAST_CITATIONS: usize = 20;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns `true` if `c` can be part of a word.
fn is_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

/// Returns the text after each `word` in `line` that isn't part of a longer word.
fn after_word<'a>(line: &'a str, word: &str) -> Vec<&'a str> {
    let found = line.match_indices(word).filter_map(|(at, _)| {
        let (before, after) = (&line[..at], &line[at + word.len()..]);
        (!before.ends_with(is_word) && !after.starts_with(is_word)).then_some(after)
    });
    found.collect()
}

/// Splits off the section number at the start of `text`: digits and points, without a point at the end.
fn section_number(text: &str) -> Option<(&str, &str)> {
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let number = text[..end].trim_end_matches('.');
    number.starts_with(|c: char| c.is_ascii_digit()).then(|| (number, &text[number.len()..]))
}

/// Returns the numbers of the sections that `line` cites.
fn citations(line: &str) -> Vec<&str> {
    let mut cited = vec![];
    for after in after_word(line, "spec").into_iter().chain(after_word(line, "Spec")) {
        let mut next = after.strip_prefix(' ').and_then(section_number);
        while let Some((number, rest)) = next {
            cited.push(number);
            let joined = [", and ", ", ", " and ", " to "].iter().find_map(|joint| rest.strip_prefix(joint));
            next = joined.and_then(section_number);
        }
    }
    cited
}

/// Returns the numbers of the sections of a specification, `## N Title` and `### N.M Title`, in order.
fn sections(specification: &str) -> Vec<&str> {
    let headings = specification.lines().filter(|line| line.starts_with("##"));
    let numbers = headings.map(|heading| {
        let (marks, title) = heading.split_once(' ').expect("a title");
        let (number, title) = section_number(title).unwrap_or_else(|| panic!("{heading}: no number"));
        assert_eq!(number.split('.').count() + 1, marks.len(), "{heading}: another level than its number's");
        assert!(title.starts_with(' ') && title.trim().len() > 1, "{heading}: no title");
        number
    });
    numbers.collect()
}

/// Collects the text files in `place`, with their paths from the root; none if it doesn't exist. Skips hidden files, Python's
/// caches and third-party modules.
fn texts(place: &str, found: &mut Vec<(String, String)>) {
    let path = root().join(place);
    if path.is_dir() {
        let mut names: Vec<String> = fs::read_dir(&path)
            .expect("a readable folder")
            .map(|entry| entry.expect("a readable entry").file_name().to_string_lossy().into_owned())
            .filter(|name| {
                !name.starts_with('.') && !["__pycache__", "node_modules"].contains(&name.as_str())
            })
            .collect();
        names.sort();
        names.iter().for_each(|name| texts(&format!("{place}/{name}"), found));
    } else if path.is_file()
        && place != THIS_FILE
        && let Ok(text) = String::from_utf8(fs::read(&path).expect("a readable file"))
    {
        found.push((place.to_string(), text));
    }
}

fn all_texts() -> Vec<(String, String)> {
    let mut found = vec![];
    for place in PLACES {
        assert!(root().join(place).exists(), "{place} is not there");
    }
    PLACES.into_iter().chain(OPTIONAL_PLACES).for_each(|place| texts(place, &mut found));
    found
}

fn specification() -> String {
    let path: PathBuf = root().join(SPECIFICATION);
    fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

#[test]
fn every_citation_has_its_section() {
    let specification = specification();
    let sections = sections(&specification);
    let (mut outside, mut missing) = (0, vec![]);
    for (file, text) in all_texts() {
        for (number, line) in (1..).zip(text.lines()) {
            let cited = citations(line);
            outside += if file == SPECIFICATION { 0 } else { cited.len() };
            let absent = cited.into_iter().filter(|cited| !sections.contains(cited));
            missing.extend(absent.map(|cited| format!("{file}:{number} cites spec {cited}")));
        }
    }
    assert!(missing.is_empty(), "{SPECIFICATION} has no such section:\n{}", missing.join("\n"));
    assert!(outside >= LEAST_CITATIONS, "only {outside} citations were found");
}

#[test]
fn nothing_cites_in_the_old_form() {
    // In two parts, so that the search doesn't find this line.
    let old = ["SP", "EC"].concat();
    let mut found = vec![];
    for (file, text) in all_texts() {
        let lines = (1..).zip(text.lines()).filter(|(_, line)| !after_word(line, &old).is_empty());
        found.extend(lines.map(|(number, line)| format!("{file}:{number}: {}", line.trim())));
    }
    assert!(found.is_empty(), "a citation is written spec N.M:\n{}", found.join("\n"));
}

#[test]
fn sections_are_numbered_without_gaps() {
    let specification = specification();
    let (mut top, mut below) = (0, 0);
    for number in sections(&specification) {
        let expected = match number.contains('.') {
            true => {
                below += 1;
                format!("{top}.{below}")
            }
            false => {
                (top, below) = (top + 1, 0);
                top.to_string()
            }
        };
        assert_eq!(number, expected);
    }
    assert_eq!(top, 10, "code cites ten sections");
}

#[test]
fn citations_are_found() {
    for (line, expected) in [
        ("//! Image tokens (spec 3.1).", &["3.1"][..]),
        ("Spec 3 says so, and spec 4.2.", &["4.2", "3"]),
        ("`spec 3.1 and 3.2` or spec 10.11", &["3.1", "3.2", "10.11"]),
        ("spec 3 to 5: the network", &["3", "5"]),
        ("# spec 7.3, 7.5 and 7.6", &["7.3", "7.5", "7.6"]),
        ("spec 7.3, 7.5, and 7.6", &["7.3", "7.5", "7.6"]),
        ("spec 3.1, which has 24 views and 12 more", &["3.1"]),
        ("spec 6.", &["6"]),
        // These sections don't exist, and must be found to be missing.
        ("spec 3.1.2", &["3.1.2"]),
        ("spec 03", &["03"]),
        // None of these is a citation.
        ("the spec, 3 of them", &[]),
        ("docs/spec.md 3", &[]),
        ("specs 3, spec. 3, spec3, spec  3, inspec 3, my_spec 3, spec_3 3", &[]),
        ("spec .5, spec and 3", &[]),
        ("spec", &[]),
        ("", &[]),
    ] {
        assert_eq!(citations(line), expected, "{line}");
    }
}

#[test]
fn words_are_whole() {
    let old = ["SP", "EC"].concat();
    for (text, found) in
        [("(@ section 6)", 1), ("@.md and @", 2), ("see @", 1), ("IN@T, @S, @_X, X_@, É@", 0), ("spec", 0)]
    {
        assert_eq!(after_word(&text.replace('@', &old), &old).len(), found, "{text}");
    }
}

#[test]
fn headings_are_read() {
    let text = "# Title\n\ntext, # and ## in it\n## 1 One\n### 1.1 First\n### 1.2 Second\n## 2 Two\n";
    assert_eq!(sections(text), ["1", "1.1", "1.2", "2"]);
    for broken in ["## One", "## 1", "### 1 One", "## 1.1 One", "##1 One", "## 1.One"] {
        assert!(std::panic::catch_unwind(|| sections(broken)).is_err(), "{broken}");
    }
}
