//! Names of command-line options in errors of the library, which has no options.

/// Phrases of the library's errors, and the program's words for them.
const PHRASES: [(&str, &str); 10] = [
    ("choose another output folder", "choose another --out"),
    ("or Resume::Auto to go on", "or --resume auto to go on"),
    ("none with Resume::Never", "none with --resume never"),
    ("`globalsplat train` writes", "`globalsplat train --out` writes"),
    ("`globalsplat train` made", "`globalsplat train --out` made"),
    ("shards_optimizer ", "--shard-optimizer "),
    ("or a size for all photos", "or --size WxH"),
    ("a single one, or its name", "a single one, as --dataset names"),
    ("(by holdout or data.holdout", "(--holdout or data.holdout"),
    ("the height of the photos is ", "--views-at is "),
];
/// Start of the library's errors about an override of a configuration key.
const OVERRIDE: &str = "override ";

/// Returns the message of an error with the names of the options that the user can change.
pub fn name_options(message: &str) -> String {
    let message = match message.strip_prefix(OVERRIDE) {
        Some(assignment) => format!("--set {assignment}"),
        None => message.to_string(),
    };
    PHRASES.iter().fold(message, |message, (phrase, named)| message.replace(phrase, named))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    /// Adds the text of every source file of the library in `folder` to `text`.
    fn add_sources(folder: &Path, text: &mut String) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() && !path.ends_with("cli") {
                add_sources(&path, text);
            } else if path.extension().is_some_and(|ending| ending == "rs") {
                text.push_str(&std::fs::read_to_string(path).unwrap());
            }
        }
    }

    #[test]
    fn every_phrase_is_one_of_the_library() {
        let mut text = String::new();
        for folder in ["src", "crates"] {
            add_sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join(folder), &mut text);
        }
        for phrase in PHRASES.iter().map(|(phrase, _)| *phrase).chain([OVERRIDE]) {
            // The source contains only the name of a setting, without " is ".
            let phrase = phrase.strip_suffix(" is ").unwrap_or(phrase);
            assert!(text.contains(phrase), "no error of the library says {phrase:?}");
        }
    }

    #[test]
    fn options_are_named() {
        assert_eq!(name_options("override model.depth=3: unknown"), "--set model.depth=3: unknown");
        assert_eq!(name_options("the height of the photos is 50, expected"), "--views-at is 50, expected");
        assert_eq!(name_options("a: override b"), "a: override b");
    }
}
