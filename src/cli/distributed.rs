//! Distributed runs: this process as one of several that `torchrun` started.

use super::device;
use crate::distributed::{DistributedEnv, ProcessGroup, Rendezvous};
use crate::error::{Error, Result};
use std::sync::OnceLock;
use tch::Device;

/// Connection to the other processes, if there are any.
static RENDEZVOUS: OnceLock<Rendezvous> = OnceLock::new();

/// Joins the group of processes started together with this one, to work on the device called `name`: `cuda` means a GPU of its
/// own for each process.
pub fn join(name: &str) -> Result<(ProcessGroup, Device)> {
    let Some(dist_env) = DistributedEnv::from_env()? else {
        return Ok((ProcessGroup::single(), device::parse(name)?));
    };
    let rendezvous = Rendezvous::connect(dist_env.clone())?;
    let rendezvous = RENDEZVOUS.get_or_init(|| rendezvous);
    // The processes of a machine share its cores, as torchrun divides libtorch's threads.
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = (cores / dist_env.local_world_size).max(1);
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build_global()
        .expect("nothing has used threads yet");
    let device = match name {
        "cuda" => device::parse(&format!("cuda:{}", dist_env.local_rank))?,
        one if one.starts_with("cuda:") && dist_env.local_world_size > 1 => {
            let why = format!(
                "{} processes of this machine can't share a GPU, expected --device cuda",
                dist_env.local_world_size
            );
            return Err(Error::request(format!("--device {one}: {why}")));
        }
        name => device::parse(name)?,
    };
    Ok((ProcessGroup::join(rendezvous, device)?, device))
}

/// Returns `true` in the process that prints messages on behalf of all.
pub fn is_main_process() -> bool {
    !matches!(DistributedEnv::from_env(), Ok(Some(DistributedEnv { rank: 1.., .. })))
}

/// Returns an error if torchrun started several processes for a command that can't be distributed.
pub fn require_single_process() -> Result<()> {
    let by_torchrun = std::env::var_os("TORCHELASTIC_RUN_ID").is_some();
    let Ok(Some(DistributedEnv { rank, ranks, .. })) = DistributedEnv::from_env() else { return Ok(()) };
    match (by_torchrun, rank) {
        (false, _) => Ok(()),
        (true, 0) => Err(Error::request(format!(
            "this is work for one process, and torchrun started {ranks}: expected train, eval --data or bench train"
        ))),
        // The first process reports the error.
        (true, _) => std::process::exit(super::WRONG_REQUEST.into()),
    }
}

/// Returns the error message that this process should print, or `None` if another process reports it.
/// `is_secondary` is `true` for a failed collective, which is usually the consequence of another rank's error.
pub fn message_to_print(message: &str, is_secondary: bool) -> Option<String> {
    match RENDEZVOUS.get() {
        Some(rendezvous) => rendezvous.message_to_print(message, is_secondary),
        None => Some(message.into()),
    }
}
