//! Rank of this process among those that `torchrun` started, read from the environment.

use crate::error::{Error, Result};
use std::env;
use std::str::FromStr;

/// Position of a process among the processes that were started together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// Number of this process among all processes on all machines, from 0.
    pub rank: usize,
    /// Number of processes on all machines.
    pub ranks: usize,
    /// Number of this process among those on this machine, from 0.
    pub local_rank: usize,
    /// Number of processes on this machine.
    pub local_world_size: usize,
    /// Number of times that all processes have been restarted.
    pub restarts: u64,
    /// Host of the store through which the processes connect.
    pub host: String,
    /// Port of the store.
    pub port: u16,
    /// `true` if `torchrun` hosts the store; otherwise the first rank hosts it.
    pub store_is_kept: bool,
}

impl Place {
    /// Reads this process's position from the environment. Returns `None` if the process was started alone.
    ///
    /// # Errors
    /// Returns an error if a variable is missing or has a value that `torchrun` doesn't set.
    pub fn from_env() -> Result<Option<Self>> {
        Place::told_by(|name| env::var(name).ok())
    }

    fn told_by(variable: impl Fn(&str) -> Option<String>) -> Result<Option<Self>> {
        if variable("WORLD_SIZE").is_none() {
            return Ok(None);
        }
        let variable = Variables(variable);
        let ranks = variable.number("WORLD_SIZE", None)?;
        if ranks == 1 {
            return Ok(None);
        }
        let rank = variable.number("RANK", None)?;
        if rank >= ranks {
            return Err(Error::setting(
                "the environment's RANK",
                rank,
                format!("less than WORLD_SIZE, {ranks}"),
            ));
        }
        Ok(Some(Place {
            rank,
            ranks,
            local_rank: variable.number("LOCAL_RANK", Some(0))?,
            local_world_size: variable.number("LOCAL_WORLD_SIZE", Some(1))?.max(1),
            restarts: variable.number("TORCHELASTIC_RESTART_COUNT", Some(0))?,
            host: variable.text("MASTER_ADDR")?,
            port: variable.number("MASTER_PORT", None)?,
            store_is_kept: (variable.0)("TORCHELASTIC_USE_AGENT_STORE").as_deref() == Some("True"),
        }))
    }
}

/// Environment variables, read by a function.
struct Variables<F>(F);

impl<F: Fn(&str) -> Option<String>> Variables<F> {
    fn text(&self, name: &str) -> Result<String> {
        let absent = || {
            let expected = "what torchrun sets beside WORLD_SIZE (unset WORLD_SIZE to work alone)";
            Error::setting(format!("the environment's {name}"), "absent", expected)
        };
        (self.0)(name).ok_or_else(absent)
    }

    /// Parses the variable `name`. If it is missing, returns `otherwise`, or an error if that is `None`.
    fn number<T: FromStr>(&self, name: &str, otherwise: Option<T>) -> Result<T> {
        let text = match (self.text(name), otherwise) {
            (Ok(text), _) => text,
            (Err(_), Some(otherwise)) => return Ok(otherwise),
            (Err(absent), None) => return Err(absent),
        };
        let wrong = |_| Error::setting(format!("the environment's {name}"), &text, "a whole number");
        text.parse().map_err(wrong)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(variables: &[(&str, &str)]) -> Result<Option<Place>> {
        let find =
            |name: &str| variables.iter().find(|(of, _)| *of == name).map(|(_, value)| value.to_string());
        Place::told_by(find)
    }

    const ALL: [(&str, &str); 8] = [
        ("WORLD_SIZE", "8"),
        ("RANK", "5"),
        ("LOCAL_RANK", "1"),
        ("LOCAL_WORLD_SIZE", "4"),
        ("MASTER_ADDR", "node-0"),
        ("MASTER_PORT", "29500"),
        ("TORCHELASTIC_RESTART_COUNT", "2"),
        ("TORCHELASTIC_USE_AGENT_STORE", "True"),
    ];

    #[test]
    fn torchrun_is_understood() {
        let found = place(&ALL).unwrap().unwrap();
        let host = "node-0".to_string();
        let expected = Place {
            rank: 5,
            ranks: 8,
            local_rank: 1,
            local_world_size: 4,
            restarts: 2,
            host,
            port: 29500,
            store_is_kept: true,
        };
        assert_eq!(found, expected);
        // Other launchers set at least these variables.
        let others = place(&[ALL[0], ALL[1], ALL[4], ALL[5]]).unwrap().unwrap();
        assert_eq!((others.local_rank, others.local_world_size, others.store_is_kept), (0, 1, false));
    }

    #[test]
    fn who_is_alone_needs_nothing() {
        assert_eq!(place(&[]).unwrap(), None);
        assert_eq!(place(&[("RANK", "0")]).unwrap(), None);
        assert_eq!(place(&[("WORLD_SIZE", "1"), ("RANK", "0")]).unwrap(), None);
    }

    #[test]
    fn a_broken_environment_is_one_sentence() {
        let error = |variables: &[(&str, &str)]| place(variables).unwrap_err().to_string();
        let absent = error(&ALL[..5]);
        assert!(
            absent.starts_with("the environment's MASTER_PORT is absent, expected what torchrun"),
            "{absent}"
        );
        let wrong = |name: &str, value: &'static str| {
            error(&ALL.map(|(of, kept)| (of, if of == name { value } else { kept })))
        };
        assert_eq!(
            wrong("WORLD_SIZE", "many"),
            "the environment's WORLD_SIZE is many, expected a whole number"
        );
        assert_eq!(
            wrong("MASTER_PORT", "70000"),
            "the environment's MASTER_PORT is 70000, expected a whole number"
        );
        assert_eq!(wrong("RANK", "8"), "the environment's RANK is 8, expected less than WORLD_SIZE, 8");
    }
}
