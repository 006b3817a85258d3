//! Who is still there. A process that dies closes its connections, and the others' collectives fail at once; one that hangs, or
//! whose machine is gone, closes nothing. So every rank gives a sign of life now and then, and one that gives none is told of.
//! Whatever goes wrong, one rank says so for all.

use super::place::Place;
use crate::error::{Error, Result};
use cxx::UniquePtr;
use globalsplat_csrc::ranks as ffi;
use std::sync::Mutex;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Between signs of life.
const BEAT: Duration = Duration::from_secs(2);
/// After which a rank is taken for lost. Where torchrun sees one of its processes die it ends the others within 30 seconds, whatever a
/// GPU keeps them waiting for; this comes before.
const SILENCE: Duration = Duration::from_secs(25);
/// For the others to come and meet at all.
const MEETING_SECONDS: i64 = 300;
/// A rank that fails says why before its connections close; who only sees them close gives it this much time.
const GRACE: Duration = Duration::from_secs(2);

/// Gives this rank's signs of life, listens for those of others, and speaks for all where nobody has yet.
pub struct Watch {
    store: UniquePtr<ffi::Store>,
    place: Place,
    thread: Mutex<Option<(Sender<()>, JoinHandle<()>)>>,
}

/// The words that ranks leave for each other.
mod key {
    pub const SPOKEN: &str = "spoken";
    /// The number of a rank that is lost, plus 1.
    pub const LOST: &str = "lost";

    pub fn beats(rank: usize) -> String {
        format!("beats/{rank}")
    }

    pub fn left(rank: usize) -> String {
        format!("left/{rank}")
    }
}

impl Watch {
    /// Connects this rank with the others. `end` is called in another thread, at most once, when a rank gives no sign of life any
    /// more, with a sentence on that if this rank is to say it.
    ///
    /// # Errors
    /// A store that can't be reached.
    pub fn begin(place: &Place, end: impl FnOnce(Option<String>) + Send + 'static) -> Result<Self> {
        let serves = !place.store_is_kept && place.rank == 0;
        let prefix = format!("globalsplat/{}", place.restarts);
        let store = ffi::connect(&place.host, place.port, serves, &prefix, MEETING_SECONDS);
        let store = store.map_err(|e| {
            let why = e.what().lines().next().unwrap_or_default().to_string();
            let Place { rank, ranks, host, port, .. } = place;
            Error::Failed(format!("rank {rank} of {ranks} can't reach the others at {host}:{port}: {why}"))
        })?;
        let (sender, receiver) = channel();
        let own = Watch { store: store.another()?, place: place.clone(), thread: Mutex::default() };
        let listen = move || {
            let mut others = Others::of(&own.place);
            while receiver.recv_timeout(BEAT) == Err(RecvTimeoutError::Timeout) {
                if let Some(why) = others.lost(&own.store) {
                    return end(own.speak(&why));
                }
            }
        };
        let thread = std::thread::Builder::new().name("watch".into()).spawn(listen);
        let thread = thread.map_err(|e| Error::Failed(format!("a thread can't be started: {e}")))?;
        Ok(Watch { store, place: place.clone(), thread: Mutex::new(Some((sender, thread))) })
    }

    /// Through which ranks meet.
    pub fn store(&self) -> &ffi::Store {
        &self.store
    }

    /// What this rank should print of why it fails; nothing where another has spoken.
    pub fn tell(&self, error: &str, others_are_lost: bool) -> Option<String> {
        if others_are_lost {
            std::thread::sleep(GRACE);
        }
        self.speak(error)
    }

    fn speak(&self, why: &str) -> Option<String> {
        // A store that is gone can't tell who spoke.
        let spoken = self.store.add(key::SPOKEN, 1).is_ok_and(|times| times > 1);
        let who = match self.place.rank {
            0 => String::new(),
            rank => format!("rank {rank} of {}: ", self.place.ranks),
        };
        (!spoken).then(|| who + why)
    }

    /// This rank's silence means nothing from here on. Whoever keeps the store waits until the others have left, too.
    pub fn leave(&self) {
        let Some((sender, thread)) = self.thread.lock().expect("no thread panics here").take() else {
            return;
        };
        drop(sender);
        let _ = thread.join();
        let _ = self.store.add(&key::left(self.place.rank), 1);
        if !self.place.store_is_kept && self.place.rank == 0 {
            let has_left = |rank| !matches!(self.store.add(&key::left(rank), 0), Ok(0));
            let since = Instant::now();
            while since.elapsed() < SILENCE && !(1..self.place.ranks).all(has_left) {
                std::thread::sleep(Duration::from_millis(20));
            }
        }
    }
}

/// What a rank knows of those that it listens to: the first one to all, the others to that.
struct Others {
    rank: usize,
    ranks: usize,
    /// Rank, beats heard, and when the last one came.
    heard: Vec<(usize, i64, Instant)>,
}

impl Others {
    fn of(place: &Place) -> Self {
        let listened_to = if place.rank == 0 { 1..place.ranks } else { 0..1 };
        let heard = listened_to.map(|rank| (rank, 0, Instant::now())).collect();
        Others { rank: place.rank, ranks: place.ranks, heard }
    }

    /// Gives a sign of life, and tells of a rank that gives none.
    fn lost(&mut self, store: &ffi::Store) -> Option<String> {
        match self.listen(store) {
            Ok(None) => None,
            Ok(Some(rank)) => {
                let seconds = SILENCE.as_secs();
                Some(format!("rank {rank} of {} gave no sign of life for {seconds} seconds", self.ranks))
            }
            Err(_) => Some("the store through which the processes meet is gone, and torchrun with it".into()),
        }
    }

    fn listen(&mut self, store: &ffi::Store) -> std::result::Result<Option<usize>, cxx::Exception> {
        store.add(&key::beats(self.rank), 1)?;
        if let rank @ 1.. = store.add(key::LOST, 0)? {
            return Ok(Some(rank as usize - 1));
        }
        for (rank, beats, last) in &mut self.heard {
            let now = store.add(&key::beats(*rank), 0)?;
            if now != *beats || store.add(&key::left(*rank), 0)? > 0 {
                (*beats, *last) = (now, Instant::now());
            } else if last.elapsed() > SILENCE {
                store.add(key::LOST, *rank as i64 + 1)?;
                return Ok(Some(*rank));
            }
        }
        Ok(None)
    }
}
