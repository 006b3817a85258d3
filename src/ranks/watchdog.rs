//! Detection of lost ranks. A process that dies closes its connections, and the collectives of the others fail at once. A process that
//! hangs, or whose machine is gone, closes nothing. So every rank sends a heartbeat at regular intervals, and a rank that sends none is
//! reported as lost. For any failure, one rank prints the message for all.

use super::dist_env::DistributedEnv;
use crate::error::{Error, Result};
use cxx::UniquePtr;
use globalsplat_csrc::ranks as ffi;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Time between heartbeats.
const HEARTBEAT_INTERVAL: Duration = Duration::from_secs(2);
/// Time without a heartbeat after which a rank counts as lost. If one of torchrun's processes dies, torchrun ends the others within 30
/// seconds, even if they are waiting for a GPU; this timeout is shorter.
const HEARTBEAT_TIMEOUT: Duration = Duration::from_secs(25);
/// Timeout for all ranks to connect, in seconds.
const CONNECT_TIMEOUT_SECONDS: i64 = 300;
/// Time for a failing rank to print its error. It does so before its connections close; a rank that only sees them close waits this long.
const GRACE: Duration = Duration::from_secs(2);

/// Watchdog of a rank: sends its heartbeats, checks those of others, and prints an error if no other rank has printed one.
pub struct Watchdog {
    store: UniquePtr<ffi::Store>,
    dist_env: DistributedEnv,
    /// Channel that keeps the heartbeat thread running. Dropping it ends the thread.
    listening: Mutex<Option<Sender<()>>>,
}

/// Keys of the counters in the store, by which ranks communicate.
mod key {
    /// Number of times that a rank wanted to print an error.
    pub const SPOKEN: &str = "spoken";
    /// Number of ranks that have ended with a failure.
    pub const FAILED: &str = "failed";
    /// Number of a rank that sends no heartbeat, plus 1.
    pub const LOST: &str = "lost";

    pub fn beats(rank: usize) -> String {
        format!("beats/{rank}")
    }

    pub fn left(rank: usize) -> String {
        format!("left/{rank}")
    }
}

impl Watchdog {
    /// Connects this rank to the others. If the others can't be reached any more, `end` is called in another thread, with an error message
    /// if this rank is to print it. `end` doesn't return.
    ///
    /// # Errors
    /// Returns an error if the store can't be reached.
    pub fn begin(dist_env: &DistributedEnv, end: fn(Option<String>)) -> Result<Self> {
        let is_server = !dist_env.is_agent_store && dist_env.rank == 0;
        // A store that torchrun hosts is the same after a restart.
        let round = if dist_env.is_agent_store { dist_env.restarts } else { 0 };
        let store = ffi::connect(
            &dist_env.host,
            dist_env.port,
            is_server,
            &format!("globalsplat/{round}"),
            CONNECT_TIMEOUT_SECONDS,
        );
        let store = store.map_err(|e| {
            let why = e.what().lines().next().unwrap_or_default().to_string();
            let DistributedEnv { rank, ranks, host, port, .. } = dist_env;
            Error::failed(format!("rank {rank} of {ranks} can't reach the others at {host}:{port}: {why}"))
        })?;
        let (sender, receiver) = channel();
        let listening = Mutex::new(Some(sender));
        let own = Watchdog {
            store: store.clone_connection()?,
            dist_env: dist_env.clone(),
            listening: Mutex::default(),
        };
        // Calls to a store whose machine is gone block, so another thread checks when the store last answered.
        let answered = Arc::new(Mutex::new(Some(Instant::now())));
        let last = answered.clone();
        let listen = move || {
            let mut others = PeerHeartbeats::new(&own.dist_env);
            loop {
                match others.exchange_heartbeats(&own.store) {
                    Some(why) => return end(own.claim_message(&why)),
                    None => *last.lock().expect("no thread panics here") = Some(Instant::now()),
                }
                if receiver.recv_timeout(HEARTBEAT_INTERVAL) != Err(RecvTimeoutError::Timeout) {
                    break;
                }
            }
            *last.lock().expect("no thread panics here") = None;
        };
        let says = dist_env.local_rank == 0;
        let check = move || {
            while let Some(last) = { *answered.lock().expect("no thread panics here") } {
                if last.elapsed() > HEARTBEAT_TIMEOUT {
                    let seconds = HEARTBEAT_TIMEOUT.as_secs();
                    let why = format!("the rendezvous store has not answered for {seconds} seconds");
                    return end(says.then_some(why));
                }
                std::thread::sleep(HEARTBEAT_INTERVAL);
            }
        };
        for (name, work) in
            [("listen", Box::new(listen) as Box<dyn FnOnce() + Send>), ("check", Box::new(check))]
        {
            let thread = std::thread::Builder::new().name(name.into()).spawn(work);
            thread.map_err(Error::failed_by("a thread can't be started"))?;
        }
        Ok(Watchdog { store, dist_env: dist_env.clone(), listening })
    }

    /// Returns the store through which the ranks connect.
    pub fn store(&self) -> &ffi::Store {
        &self.store
    }

    /// Returns the message that this rank should print for its failure, or `None` if another rank has printed one.
    pub fn message_to_print(&self, error: &str, others_are_lost: bool) -> Option<String> {
        if others_are_lost {
            std::thread::sleep(GRACE);
        }
        self.claim_message(error)
    }

    fn claim_message(&self, why: &str) -> Option<String> {
        let speaks = match self.store.add(key::SPOKEN, 1) {
            Ok(times) => times == 1,
            // If the store is gone, nobody knows which rank has printed an error.
            Err(_) => self.dist_env.local_rank == 0,
        };
        let who = match self.dist_env.rank {
            0 => String::new(),
            rank => format!("rank {rank} of {}: ", self.dist_env.ranks),
        };
        speaks.then(|| who + why)
    }

    /// Ends the watch, as this rank's last action: a rank that has left isn't missed. If it `failed`, the other ranks end, too. A rank that
    /// hosts the store waits until the others have seen this.
    pub fn leave(&self, failed: bool) {
        let Some(_listening) = self.listening.lock().expect("no thread panics here").take() else { return };
        let left = key::left(self.dist_env.rank);
        let _ = self.store.add(if failed { key::FAILED } else { &left }, 1);
        if !self.dist_env.is_agent_store && self.dist_env.rank == 0 {
            let patience = if failed { 2 * HEARTBEAT_INTERVAL } else { HEARTBEAT_TIMEOUT };
            let has_left = |rank| !matches!(self.store.add(&key::left(rank), 0), Ok(0));
            let since = Instant::now();
            while since.elapsed() < patience && !(1..self.dist_env.ranks).all(has_left) {
                std::thread::sleep(Duration::from_millis(20));
            }
        }
    }
}

/// Heartbeats of the ranks that this rank checks. The first rank checks all others, and the others check the first.
struct PeerHeartbeats {
    rank: usize,
    ranks: usize,
    /// Rank, number of heartbeats seen, and the time of the last one.
    heard: Vec<(usize, i64, Instant)>,
}

impl PeerHeartbeats {
    fn new(dist_env: &DistributedEnv) -> Self {
        let listened_to = if dist_env.rank == 0 { 1..dist_env.ranks } else { 0..1 };
        let heard = listened_to.map(|rank| (rank, 0, Instant::now())).collect();
        PeerHeartbeats { rank: dist_env.rank, ranks: dist_env.ranks, heard }
    }

    /// Sends a heartbeat. Returns the reason if the other ranks can't be reached any more.
    fn exchange_heartbeats(&mut self, store: &ffi::Store) -> Option<String> {
        match self.try_exchange_heartbeats(store) {
            Ok(found) => found,
            Err(_) => Some("lost the connection to the rendezvous store: its host process has ended".into()),
        }
    }

    fn try_exchange_heartbeats(
        &mut self,
        store: &ffi::Store,
    ) -> std::result::Result<Option<String>, cxx::Exception> {
        store.add(&key::beats(self.rank), 1)?;
        if store.add(key::FAILED, 0)? > 0 {
            // The rank that failed has already printed its error.
            return Ok(Some("another process has failed".into()));
        }
        let silent = |rank: usize| {
            let (ranks, seconds) = (self.ranks, HEARTBEAT_TIMEOUT.as_secs());
            Some(format!("rank {rank} of {ranks} sent no heartbeat for {seconds} seconds"))
        };
        if let rank @ 1.. = store.add(key::LOST, 0)? {
            return Ok(silent(rank as usize - 1));
        }
        for (rank, beats, last) in &mut self.heard {
            let now = store.add(&key::beats(*rank), 0)?;
            // Machines don't start at the same time.
            let patience = if *beats == 0 {
                Duration::from_secs(CONNECT_TIMEOUT_SECONDS as u64)
            } else {
                HEARTBEAT_TIMEOUT
            };
            if now != *beats || store.add(&key::left(*rank), 0)? > 0 {
                (*beats, *last) = (now, Instant::now());
            } else if last.elapsed() > patience {
                store.add(key::LOST, *rank as i64 + 1)?;
                return Ok(silent(*rank));
            }
        }
        Ok(None)
    }
}
