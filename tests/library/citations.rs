//! Every citation of the specification, docs/spec.md, refers to an existing section.
//!
//! A citation is on one line: the word `spec` or `Spec`, a space, and the number of a section, `N` or `N.M`; after a comma, `and` or
//! `to` may follow further numbers.

use super::architecture::files;
use std::path::Path;

/// Files and folders that may cite the specification, relative to the repository's root.
const PLACES: [&str; 12] = [
    "src",
    "crates",
    "csrc",
    "parity",
    "tests",
    "fuzz",
    "configs",
    "scripts",
    "docs",
    "examples",
    "README.md",
    "CONTRIBUTING.md",
];
/// Path of this file, whose examples cite sections that don't exist.
const THIS_FILE: &str = "library/citations.rs";

/// Returns the numbers of the sections that `line` cites.
fn citations(line: &str) -> Vec<&str> {
    let (mut cited, mut is_citing) = (vec![], false);
    for word in line.split(' ') {
        let end = word.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(word.len());
        let number = word[..end].trim_end_matches('.');
        if is_citing && number.starts_with(|c: char| c.is_ascii_digit()) {
            cited.push(number);
            is_citing = ["", ","].contains(&&word[number.len()..]);
        } else if !is_citing || !["and", "to"].contains(&word) {
            let last = word.rsplit(|c: char| !c.is_alphanumeric() && c != '_').next();
            is_citing = last == Some("spec") || last == Some("Spec");
        }
    }
    cited
}

/// Returns the numbers of the sections of the specification, `## N Title` and `### N.M Title`, in order.
fn sections() -> Vec<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/spec.md");
    let text = std::fs::read_to_string(path).expect("the specification");
    let headings = text.lines().filter(|line| line.starts_with("##"));
    let numbers = headings.map(|heading| match heading.split(' ').collect::<Vec<_>>()[..] {
        [marks, number, _, ..] if marks.len() == number.split('.').count() + 1 => number.to_string(),
        _ => panic!("{heading}: expected a number of its level, and a title"),
    });
    numbers.collect()
}

#[test]
fn every_citation_has_its_section() {
    let sections = sections();
    let (mut count, mut missing) = (0, vec![]);
    let places = PLACES.iter().flat_map(|place| files(&Path::new(env!("CARGO_MANIFEST_DIR")).join(place)));
    for file in places.filter(|file| !file.ends_with(THIS_FILE)) {
        let Ok(text) = String::from_utf8(std::fs::read(&file).expect("a readable file")) else { continue };
        for cited in text.lines().flat_map(citations) {
            count += 1;
            if !sections.iter().any(|section| section == cited) {
                missing.push(format!("{} cites spec {cited}", file.display()));
            }
        }
    }
    assert!(missing.is_empty(), "docs/spec.md has no such section:\n{}", missing.join("\n"));
    assert!(count >= 150, "only {count} citations were found");
}

#[test]
fn sections_are_numbered_without_gaps() {
    let (mut top, mut below) = (0, 0);
    for number in sections() {
        (top, below) = if number.contains('.') { (top, below + 1) } else { (top + 1, 0) };
        let expected = if below > 0 { format!("{top}.{below}") } else { top.to_string() };
        assert_eq!(number, expected);
    }
    assert_eq!(top, 10, "code cites ten sections");
}

#[test]
fn citations_are_found() {
    for (line, expected) in [
        ("//! Image tokens (spec 3.1).", &["3.1"][..]),
        ("Spec 3 says so, and [spec 4.2](spec.md).", &["3", "4.2"]),
        ("`spec 3.1 and 3.2` or spec 10.11", &["3.1", "3.2", "10.11"]),
        ("spec 3 to 5: the network", &["3", "5"]),
        ("# spec 7.3, 7.5, and 7.6", &["7.3", "7.5", "7.6"]),
        ("spec 3.1, which has 24 views and 12 more", &["3.1"]),
        // These sections don't exist, and must be found to be missing.
        ("spec 3.1.2 or spec 03", &["3.1.2", "03"]),
        ("the spec, 3 of them, docs/spec.md 3, spec .5", &[]),
        ("specs 3, spec. 3, spec3, spec  3, inspec 3, my_spec 3, spec_3 3", &[]),
    ] {
        assert_eq!(citations(line), expected, "{line}");
    }
}
