//! The completions of every shell. Bash runs its own.

use crate::common::program::{globalsplat, succeed};
use std::io::Write;
use std::process::{Command, Stdio};

/// Returns what `bash` prints for `script`.
fn bash(arguments: &[&str], script: &str) -> String {
    let mut shell = Command::new("bash")
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("bash");
    shell.stdin.take().expect("a pipe").write_all(script.as_bytes()).expect("a script that bash reads");
    let output = shell.wait_with_output().expect("bash");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && errors.is_empty(), "{errors}");
    String::from_utf8(output.stdout).expect("text")
}

/// Returns what bash offers for the last of `words`.
fn completions(words: &[&str]) -> Vec<String> {
    let script = succeed(&["completions", "bash"]);
    let (last, before) = (words[words.len() - 1], words[words.len() - 2]);
    let call = format!(
        "\nCOMP_WORDS=({}); COMP_CWORD={}; _globalsplat globalsplat '{last}' '{before}'\nprintf '%s\\n' \"${{COMPREPLY[@]}}\"\n",
        words.join(" "),
        words.len() - 1
    );
    bash(&["--norc"], &(script + &call)).split_whitespace().map(String::from).collect()
}

#[test]
fn bash_completes_commands_and_options() {
    bash(&["-n"], &succeed(&["completions", "bash"]));
    assert_eq!(completions(&["globalsplat", "rec"]), ["reconstruct"]);
    assert_eq!(completions(&["globalsplat", "bench", "ras"]), ["raster"]);
    assert_eq!(completions(&["globalsplat", "refine", "--sec"]), ["--seconds"]);
    assert_eq!(completions(&["globalsplat", "refine", "--from", ""]), ["nothing", "weights"]);
}

/// Former options and the command for parity/run.py.
#[test]
fn no_shell_completes_what_is_hidden() {
    for shell in ["bash", "elvish", "fish", "powershell", "zsh"] {
        let script = succeed(&["completions", shell]);
        assert!(script.contains("reconstruct") && script.contains("holdout"), "{shell}");
        for hidden in ["parity", "views-as", "space"] {
            assert!(
                !script
                    .split(|c: char| !c.is_alphanumeric() && c != '-')
                    .any(|word| { word.trim_start_matches('-') == hidden }),
                "{shell} completes {hidden}"
            );
        }
    }
}

#[test]
fn an_unknown_shell_is_refused() {
    let output = globalsplat(&["completions", "dos"]);
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2));
    assert!(message.contains("dos") && message.contains("fish"), "{message}");
}
