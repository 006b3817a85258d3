//! Detection of lost ranks. When a process dies, its connections close and collectives on CPUs fail at once. NCCL doesn't notice, and a
//! process that is suspended or whose machine is gone closes nothing. A background thread of every rank therefore sends heartbeats; a rank
//! without them is reported as lost. A process that is alive but stuck keeps sending heartbeats and is not detected. One rank prints the
//! message for all, or one per machine if the store is unreachable.

use super::dist_env::DistributedEnv;
use crate::error::{Error, Result};
use cxx::UniquePtr;
use globalsplat_csrc::ranks as ffi;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Time between heartbeats.
const HEARTBEAT_INTERVAL: Duration = Duration::from_secs(2);
/// Time without a heartbeat after which a rank counts as lost. torchrun kills the remaining ranks 30 s after one dies; this is shorter, so
/// that our message is printed first.
const HEARTBEAT_TIMEOUT: Duration = Duration::from_secs(25);
/// Timeout for ranks to connect, for a store operation, and for a rank's first heartbeat, in seconds.
const CONNECT_TIMEOUT_SECONDS: i64 = 300;
/// Time that a rank waits when it only sees a failed collective, so that the rank that caused the failure can print its error first.
const REPORT_GRACE: Duration = Duration::from_secs(2);

/// Function that ends the process when another rank has failed or is lost, or when the store can't be reached. It gets the message if this
/// rank is to print it.
type OnLost = fn(Option<String>) -> !;

/// Watchdog of a rank: sends its heartbeats, checks those of others, and prints an error if no other rank has printed one.
pub struct Watchdog {
    reporter: ErrorReporter,
    /// Thread that sends heartbeats, until this rank leaves.
    heartbeat_thread: Mutex<Option<HeartbeatThread>>,
}

/// A running heartbeat thread.
struct HeartbeatThread {
    /// Channel that keeps the thread running. Dropping it ends the thread.
    stop_sender: Sender<()>,
    handle: JoinHandle<()>,
}

/// Keys of the counters in the store, by which ranks communicate.
mod key {
    /// Number of ranks that wanted to print an error. The first one prints it.
    pub const MESSAGE_CLAIMS: &str = "message_claims";
    /// Number of ranks that have ended with a failure.
    pub const FAILED: &str = "failed";
    /// Number of ranks that found a lost rank. The first one sets [`LOST`].
    pub const LOST_CLAIMS: &str = "lost_claims";
    /// Number of a rank that sends no heartbeat, plus 1.
    pub const LOST: &str = "lost";

    /// Number of heartbeats of `rank`.
    pub fn heartbeats_key(rank: usize) -> String {
        format!("heartbeats/{rank}")
    }

    /// Above 0 after `rank` has ended without a failure of its own.
    pub fn left_key(rank: usize) -> String {
        format!("left/{rank}")
    }
}

impl Watchdog {
    /// Connects to the store and starts the heartbeat threads. `on_lost` is called on one of them when another rank has failed or is
    /// lost, or when the store can't be reached.
    ///
    /// # Errors
    /// Returns an error if the store can't be reached.
    pub fn start(dist_env: &DistributedEnv, on_lost: OnLost) -> Result<Self> {
        let is_server = !dist_env.is_agent_store && dist_env.rank == 0;
        // torchrun's store outlives a restart, so each restart uses its own key prefix.
        let restart = if dist_env.is_agent_store { dist_env.restarts } else { 0 };
        let store = ffi::connect(
            &dist_env.host,
            dist_env.port,
            is_server,
            &format!("globalsplat/{restart}"),
            CONNECT_TIMEOUT_SECONDS,
        );
        let store = store.map_err(|e| {
            let why = e.what().lines().next().unwrap_or_default().to_string();
            let DistributedEnv { rank, ranks, host, port, .. } = dist_env;
            Error::failed(format!("rank {rank} of {ranks} can't reach the others at {host}:{port}: {why}"))
        })?;
        let (stop_sender, stop_receiver) = channel();
        let reporter = ErrorReporter { store: store.clone_connection()?, dist_env: dist_env.clone() };
        // Calls to a store whose machine is gone block, so another thread checks when the store last answered. `None` ends that thread.
        let last_answer = Arc::new(Mutex::new(Some(Instant::now())));
        let heartbeat_answer = last_answer.clone();
        let send_heartbeats = move || {
            let mut peers = PeerHeartbeats::new(&reporter.dist_env);
            loop {
                match peers.exchange_heartbeats(&reporter.store) {
                    Some(why) => {
                        let message = reporter.claim_message(&why);
                        // The rank that hosts the store may be waiting for the others to end.
                        let _ = reporter.store.add(&key::left_key(reporter.dist_env.rank), 1);
                        on_lost(message)
                    }
                    None => *heartbeat_answer.lock().expect("no thread panics here") = Some(Instant::now()),
                }
                if stop_receiver.recv_timeout(HEARTBEAT_INTERVAL) != Err(RecvTimeoutError::Timeout) {
                    break;
                }
            }
            *heartbeat_answer.lock().expect("no thread panics here") = None;
        };
        let should_print = dist_env.local_rank == 0;
        let watch_store = move || {
            while let Some(time) = { *last_answer.lock().expect("no thread panics here") } {
                if time.elapsed() > HEARTBEAT_TIMEOUT {
                    let seconds = HEARTBEAT_TIMEOUT.as_secs();
                    let why = format!("the rendezvous store has not answered for {seconds} seconds");
                    on_lost(should_print.then_some(why));
                }
                std::thread::sleep(HEARTBEAT_INTERVAL);
            }
        };
        let handle = spawn("heartbeat", send_heartbeats)?;
        spawn("store-watchdog", watch_store)?;
        Ok(Watchdog {
            reporter: ErrorReporter { store, dist_env: dist_env.clone() },
            heartbeat_thread: Mutex::new(Some(HeartbeatThread { stop_sender, handle })),
        })
    }

    /// Returns the store through which the ranks connect.
    pub fn store(&self) -> &ffi::Store {
        &self.reporter.store
    }

    /// Returns the message that this rank should print for its failure, or `None` if another rank has printed one. `is_secondary` is `true`
    /// for a failed collective, which is usually the consequence of another rank's error.
    pub fn message_to_print(&self, error: &str, is_secondary: bool) -> Option<String> {
        if is_secondary {
            std::thread::sleep(REPORT_GRACE);
        }
        self.reporter.claim_message(error)
    }

    /// Announces that this rank ends, so that the others don't report it as lost. If `failed`, the others end too. A rank that hosts the
    /// store then waits: at most 4 s after a failure, otherwise until all ranks have left, at most 25 s. After a failure it first waits for
    /// the heartbeat thread, which may be in a call to the store.
    pub fn leave(&self, failed: bool) {
        let thread = self.heartbeat_thread.lock().expect("no thread panics here").take();
        let Some(HeartbeatThread { stop_sender, handle }) = thread else { return };
        let ErrorReporter { store, dist_env } = &self.reporter;
        if failed {
            // The thread ends the process when it reads that a rank has failed, and can't tell that it is this one.
            drop(stop_sender);
            let _ = handle.join();
            let _ = store.add(key::FAILED, 1);
        } else {
            // The thread runs until the end of this function, so that a failure of another rank is still noticed.
            let _ = store.add(&key::left_key(dist_env.rank), 1);
        }
        if !dist_env.is_agent_store && dist_env.rank == 0 {
            let timeout = if failed { 2 * HEARTBEAT_INTERVAL } else { HEARTBEAT_TIMEOUT };
            // An unreachable store counts as left.
            let has_left = |rank: &usize| !matches!(store.add(&key::left_key(*rank), 0), Ok(0));
            let all_have_ended = || {
                // This rank, and after its failure those of the others that have failed too.
                let ended = if failed { store.add(key::FAILED, 0).unwrap_or(1) as usize } else { 1 };
                ended + (1..dist_env.ranks).filter(has_left).count() >= dist_env.ranks
            };
            let start = Instant::now();
            while start.elapsed() < timeout && !all_have_ended() {
                std::thread::sleep(Duration::from_millis(20));
            }
        }
    }
}

/// Starts a thread with the name `name`.
fn spawn(name: &str, run: impl FnOnce() + Send + 'static) -> Result<JoinHandle<()>> {
    let thread = std::thread::Builder::new().name(name.into()).spawn(run);
    thread.map_err(Error::failed_with_context("a thread can't be started"))
}

/// Chooses the rank that prints an error for all.
struct ErrorReporter {
    store: UniquePtr<ffi::Store>,
    dist_env: DistributedEnv,
}

impl ErrorReporter {
    /// Returns the message about the failure `why` if this is the first call on any rank. If the store is unreachable, the first rank of
    /// each machine gets the message.
    fn claim_message(&self, why: &str) -> Option<String> {
        let should_print = match self.store.add(key::MESSAGE_CLAIMS, 1) {
            Ok(claims) => claims == 1,
            Err(_) => self.dist_env.local_rank == 0,
        };
        let prefix = match self.dist_env.rank {
            0 => String::new(),
            rank => format!("rank {rank} of {}: ", self.dist_env.ranks),
        };
        should_print.then(|| prefix + why)
    }
}

/// Heartbeats of the ranks that this rank watches. The first rank watches all others, and the others watch the first.
struct PeerHeartbeats {
    rank: usize,
    ranks: usize,
    peers: Vec<Peer>,
}

/// A rank that this rank watches.
struct Peer {
    rank: usize,
    /// Number of its heartbeats, when last read.
    heartbeats: i64,
    /// Time when that number was seen to change, or the rank to have left.
    last_change: Instant,
}

impl PeerHeartbeats {
    fn new(dist_env: &DistributedEnv) -> Self {
        let watched_ranks = if dist_env.rank == 0 { 1..dist_env.ranks } else { 0..1 };
        let peers = watched_ranks.map(|rank| Peer { rank, heartbeats: 0, last_change: Instant::now() });
        PeerHeartbeats { rank: dist_env.rank, ranks: dist_env.ranks, peers: peers.collect() }
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
        store.add(&key::heartbeats_key(self.rank), 1)?;
        if store.add(key::FAILED, 0)? > 0 {
            // The rank that failed has already printed its error.
            return Ok(Some("another process has failed".into()));
        }
        let lost_message = |rank: usize| {
            let (ranks, seconds) = (self.ranks, HEARTBEAT_TIMEOUT.as_secs());
            Some(format!("rank {rank} of {ranks} sent no heartbeat for {seconds} seconds"))
        };
        if let rank @ 1.. = store.add(key::LOST, 0)? {
            return Ok(lost_message(rank as usize - 1));
        }
        for Peer { rank, heartbeats, last_change } in &mut self.peers {
            let current = store.add(&key::heartbeats_key(*rank), 0)?;
            // Machines don't start at the same time.
            let timeout = if *heartbeats == 0 {
                Duration::from_secs(CONNECT_TIMEOUT_SECONDS as u64)
            } else {
                HEARTBEAT_TIMEOUT
            };
            if current != *heartbeats || store.add(&key::left_key(*rank), 0)? > 0 {
                (*heartbeats, *last_change) = (current, Instant::now());
            } else if last_change.elapsed() > timeout {
                if store.add(key::LOST_CLAIMS, 1)? == 1 {
                    store.add(key::LOST, *rank as i64 + 1)?;
                }
                return Ok(lost_message(*rank));
            }
        }
        Ok(None)
    }
}
