//! Rank of this process among those that `torchrun` started, read from the environment.

use crate::error::{Error, Result};
use std::env;
use std::str::FromStr;

/// Position of a process among the processes that were started together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DistributedEnv {
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
    pub is_agent_store: bool,
}

impl DistributedEnv {
    /// Reads this process's position from the environment. Returns `None` if the process was started alone.
    ///
    /// # Errors
    /// Returns an error if a variable is missing or has a value that `torchrun` doesn't set.
    pub fn from_env() -> Result<Option<Self>> {
        DistributedEnv::from_variables(|name| env::var(name).ok())
    }

    fn from_variables(variable: impl Fn(&str) -> Option<String>) -> Result<Option<Self>> {
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
        Ok(Some(DistributedEnv {
            rank,
            ranks,
            local_rank: variable.number("LOCAL_RANK", Some(0))?,
            local_world_size: variable.number("LOCAL_WORLD_SIZE", Some(1))?.max(1),
            restarts: variable.number("TORCHELASTIC_RESTART_COUNT", Some(0))?,
            host: variable.text("MASTER_ADDR")?,
            port: variable.number("MASTER_PORT", None)?,
            is_agent_store: (variable.0)("TORCHELASTIC_USE_AGENT_STORE").as_deref() == Some("True"),
        }))
    }
}

/// Environment variables, read by a function.
struct Variables<F>(F);

impl<F: Fn(&str) -> Option<String>> Variables<F> {
    fn text(&self, name: &str) -> Result<String> {
        let missing = || {
            let expected =
                "the value that torchrun sets with WORLD_SIZE (unset WORLD_SIZE to run a single process)";
            Error::setting(format!("the environment's {name}"), "missing", expected)
        };
        (self.0)(name).ok_or_else(missing)
    }

    /// Parses the variable `name`. If it is missing, returns `otherwise`, or an error if that is `None`.
    fn number<T: FromStr>(&self, name: &str, otherwise: Option<T>) -> Result<T> {
        let text = match (self.text(name), otherwise) {
            (Ok(text), _) => text,
            (Err(_), Some(otherwise)) => return Ok(otherwise),
            (Err(missing), None) => return Err(missing),
        };
        let wrong = |_| Error::setting(format!("the environment's {name}"), &text, "a whole number");
        text.parse().map_err(wrong)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dist_env(variables: &[(&str, &str)]) -> Result<Option<DistributedEnv>> {
        let find =
            |name: &str| variables.iter().find(|(of, _)| *of == name).map(|(_, value)| value.to_string());
        DistributedEnv::from_variables(find)
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
        let found = dist_env(&ALL).unwrap().unwrap();
        let host = "node-0".to_string();
        let expected = DistributedEnv {
            rank: 5,
            ranks: 8,
            local_rank: 1,
            local_world_size: 4,
            restarts: 2,
            host,
            port: 29500,
            is_agent_store: true,
        };
        assert_eq!(found, expected);
        // Other launchers set at least these variables.
        let others = dist_env(&[ALL[0], ALL[1], ALL[4], ALL[5]]).unwrap().unwrap();
        assert_eq!((others.local_rank, others.local_world_size, others.is_agent_store), (0, 1, false));
    }

    #[test]
    fn single_process_needs_no_variables() {
        assert_eq!(dist_env(&[]).unwrap(), None);
        assert_eq!(dist_env(&[("RANK", "0")]).unwrap(), None);
        assert_eq!(dist_env(&[("WORLD_SIZE", "1"), ("RANK", "0")]).unwrap(), None);
    }

    #[test]
    fn a_broken_environment_is_one_sentence() {
        let error = |variables: &[(&str, &str)]| dist_env(variables).unwrap_err().to_string();
        let missing = error(&ALL[..5]);
        assert!(
            missing.starts_with("the environment's MASTER_PORT is missing, expected the value that torchrun"),
            "{missing}"
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
