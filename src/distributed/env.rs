//! Rank of this process among those that `torchrun` started, and the store through which they meet.

use crate::error::{Error, Result};
use cxx::UniquePtr;
use globalsplat_csrc::distributed as ffi;
use std::env;
use std::time::Duration;

/// Timeout for ranks to connect and for a store operation, in seconds.
const CONNECT_TIMEOUT_SECONDS: i64 = 300;
/// Time that a rank waits when it only sees a failed collective, so that the rank that caused the failure can print its error first.
const REPORT_GRACE: Duration = Duration::from_secs(2);
/// Key of the number of ranks that wanted to print an error. The first one prints it.
const MESSAGE_CLAIMS: &str = "message_claims";

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
    pub restarts: u16,
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
        let text = |name: &str| {
            let expected =
                "the value that torchrun sets with WORLD_SIZE (unset WORLD_SIZE to run a single process)";
            variable(name)
                .ok_or_else(|| Error::setting(format!("the environment's {name}"), "missing", expected))
        };
        let parse = |name: &str, text: String| -> Result<u16> {
            let wrong = |_| Error::setting(format!("the environment's {name}"), &text, "a whole number");
            text.parse().map_err(wrong)
        };
        let number = |name: &str| parse(name, text(name)?);
        let number_or = |name: &str, default| variable(name).map_or(Ok(default), |text| parse(name, text));
        let ranks = number("WORLD_SIZE")?;
        if ranks == 1 {
            return Ok(None);
        }
        let rank = number("RANK")?;
        if rank >= ranks {
            let expected = format!("less than WORLD_SIZE, {ranks}");
            return Err(Error::setting("the environment's RANK", rank, expected));
        }
        Ok(Some(DistributedEnv {
            rank: rank.into(),
            ranks: ranks.into(),
            local_rank: number_or("LOCAL_RANK", 0)?.into(),
            local_world_size: number_or("LOCAL_WORLD_SIZE", 1)?.max(1).into(),
            restarts: number_or("TORCHELASTIC_RESTART_COUNT", 0)?,
            host: text("MASTER_ADDR")?,
            port: number("MASTER_PORT")?,
            is_agent_store: variable("TORCHELASTIC_USE_AGENT_STORE").as_deref() == Some("True"),
        }))
    }
}

/// Connection to the store that all ranks share. It also chooses the rank that prints an error for all.
pub struct Rendezvous {
    pub(super) store: UniquePtr<ffi::Store>,
    pub(super) env: DistributedEnv,
}

impl Rendezvous {
    /// Connects to the store, which the first rank hosts if `torchrun` doesn't.
    ///
    /// # Errors
    /// Returns an error if the store can't be reached.
    pub fn connect(env: DistributedEnv) -> Result<Self> {
        let is_server = !env.is_agent_store && env.rank == 0;
        // torchrun's store outlives a restart, so each restart uses its own key prefix.
        let restart = if env.is_agent_store { env.restarts } else { 0 };
        let prefix = format!("globalsplat/{restart}");
        let store = ffi::connect(&env.host, env.port, is_server, &prefix, CONNECT_TIMEOUT_SECONDS);
        let store = store.map_err(|e| {
            let why = e.what().lines().next().unwrap_or_default().to_string();
            let DistributedEnv { rank, ranks, host, port, .. } = &env;
            Error::failed(format!("rank {rank} of {ranks} can't reach the others at {host}:{port}: {why}"))
        })?;
        Ok(Rendezvous { store, env })
    }

    /// Returns the message that this rank should print for its failure `error`, or `None` if another rank has printed one. `is_secondary` is
    /// `true` for a failed collective, which is usually the consequence of another rank's error. If the store is unreachable, the first rank
    /// of each machine gets the message.
    pub fn message_to_print(&self, error: &str, is_secondary: bool) -> Option<String> {
        if is_secondary {
            std::thread::sleep(REPORT_GRACE);
        }
        let should_print = match self.store.add(MESSAGE_CLAIMS, 1) {
            Ok(claims) => claims == 1,
            Err(_) => self.env.local_rank == 0,
        };
        let prefix = match self.env.rank {
            0 => String::new(),
            rank => format!("rank {rank} of {}: ", self.env.ranks),
        };
        should_print.then(|| prefix + error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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

    fn parse(variables: &[(&str, &str)]) -> Result<Option<DistributedEnv>> {
        let find = |name: &str| {
            variables.iter().find(|(known, _)| *known == name).map(|(_, value)| value.to_string())
        };
        DistributedEnv::from_variables(find)
    }

    #[test]
    fn torchrun_is_understood() {
        // Other launchers set at least these variables.
        let others = [ALL[0], ALL[1], ALL[4], ALL[5]];
        for (variables, local_rank, local_world_size, restarts, is_agent_store) in
            [(&ALL[..], 1, 4, 2, true), (&others, 0, 1, 0, false)]
        {
            let host = "node-0".into();
            let (rank, ranks, port) = (5, 8, 29500);
            let expected = DistributedEnv {
                rank,
                ranks,
                local_rank,
                local_world_size,
                restarts,
                host,
                port,
                is_agent_store,
            };
            assert_eq!(parse(variables).unwrap(), Some(expected));
        }
        for alone in [&[][..], &[("RANK", "0")], &[("WORLD_SIZE", "1"), ("RANK", "0")]] {
            assert_eq!(parse(alone).unwrap(), None);
        }
    }

    #[test]
    fn a_broken_environment_is_one_sentence() {
        let error = |variables: &[(&str, &str)]| parse(variables).unwrap_err().to_string();
        let missing = error(&ALL[..5]);
        assert!(
            missing.starts_with("the environment's MASTER_PORT is missing, expected the value that torchrun"),
            "{missing}"
        );
        for (name, value, expected) in [
            ("WORLD_SIZE", "many", "a whole number"),
            ("MASTER_PORT", "70000", "a whole number"),
            ("RANK", "8", "less than WORLD_SIZE, 8"),
        ] {
            let found = error(&ALL.map(|(known, kept)| (known, if known == name { value } else { kept })));
            assert_eq!(found, format!("the environment's {name} is {value}, expected {expected}"));
        }
    }
}
