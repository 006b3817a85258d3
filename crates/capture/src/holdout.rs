//! Split of a capture's views into those shown to the model and those held out for evaluation.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// Setting `none`, or `every:N` with an optional `+K`: views K, K + N, K + 2N, … are held out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Holdout {
    /// No view is held out.
    None,
    /// Views `first`, `first + every`, … are held out.
    Every {
        /// Interval between held-out views, at least 2.
        every: usize,
        /// Index of the first held-out view, less than `every`.
        first: usize,
    },
}

impl FromStr for Holdout {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "none" {
            return Ok(Holdout::None);
        }
        let refused =
            || format!("holdout is {text:?}, expected none, every:N or every:N+K with K < N and N ≥ 2");
        let numbers = text.strip_prefix("every:").ok_or_else(refused)?;
        let (every, first) = numbers.split_once('+').unwrap_or((numbers, "0"));
        match (every.parse(), first.parse()) {
            (Ok(every), Ok(first)) if every >= 2 && first < every => Ok(Holdout::Every { every, first }),
            _ => Err(refused()),
        }
    }
}

impl TryFrom<String> for Holdout {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<Holdout> for String {
    fn from(holdout: Holdout) -> String {
        holdout.to_string()
    }
}

impl fmt::Display for Holdout {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Holdout::None => write!(f, "none"),
            Holdout::Every { every, first: 0 } => write!(f, "every:{every}"),
            Holdout::Every { every, first } => write!(f, "every:{every}+{first}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn holdouts_are_read_and_written() {
        for text in ["none", "every:8", "every:3+1"] {
            assert_eq!(text.parse::<Holdout>().unwrap().to_string(), text);
        }
        for text in ["", "every:1", "every:3+3", "every:x", "first:2"] {
            assert!(text.parse::<Holdout>().is_err(), "{text}");
        }
    }
}
