//! Being one of several processes that `torchrun` started.

use super::device;
use globalsplat::error::{Error, Result};
use globalsplat::ranks::{Group, Place, Watch};
use std::sync::OnceLock;
use tch::Device;

/// How this process keeps in touch with its others, if it has any.
static WATCH: OnceLock<Watch> = OnceLock::new();

/// Meets the processes that were started together with this one, to work on the device called `name`: `cuda` is for each of them
/// the GPU of its own.
pub fn join(name: &str) -> Result<(Group, Device)> {
    let Some(place) = Place::of_process()? else { return Ok((Group::alone(), device::parse(name)?)) };
    let watch = Watch::begin(&place, |why| {
        why.iter().for_each(|why| eprintln!("globalsplat: {why}"));
        // Whatever waits for a rank that hangs isn't waited for.
        // SAFETY: nothing is done after it.
        unsafe { libc::_exit(super::FAILED.into()) }
    })?;
    let watch = WATCH.get_or_init(|| watch);
    // Cores are shared among the processes of a machine, as torchrun shares libtorch's threads.
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = (cores / place.local_ranks).max(1);
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build_global()
        .expect("nothing has used threads yet");
    let device = match name {
        "cuda" => device::parse(&format!("cuda:{}", place.local_rank))?,
        one if one.starts_with("cuda:") && place.local_ranks > 1 => {
            let why = format!(
                "{} processes of this machine can't share a GPU, expected --device cuda",
                place.local_ranks
            );
            return Err(Error::Request(format!("--device {one}: {why}")));
        }
        name => device::parse(name)?,
    };
    Ok((Group::join(&place, watch.store(), device)?, device))
}

/// Whether what concerns all processes alike is this one's to say.
pub fn is_first() -> bool {
    !matches!(Place::of_process(), Ok(Some(Place { rank: 1.., .. })))
}

/// That torchrun didn't start several of this process, whose work isn't shared out.
pub fn refuse() -> Result<()> {
    let by_torchrun = std::env::var_os("TORCHELASTIC_RUN_ID").is_some();
    let Ok(Some(Place { rank, ranks, .. })) = Place::of_process() else { return Ok(()) };
    match (by_torchrun, rank) {
        (false, _) => Ok(()),
        (true, 0) => Err(Error::Request(format!(
            "this is work for one process, and torchrun started {ranks}: expected train, eval --data or bench train"
        ))),
        // The first one says so.
        (true, _) => std::process::exit(super::WRONG_REQUEST.into()),
    }
}

/// What this process should print of why it fails: one of all speaks.
pub fn what_to_tell(message: &str, others_are_lost: bool) -> Option<String> {
    match WATCH.get() {
        Some(watch) => watch.tell(message, others_are_lost),
        None => Some(message.into()),
    }
}

/// The last that a process does.
pub fn leave(failed: bool) {
    if let Some(watch) = WATCH.get() {
        watch.leave(failed);
    }
}
