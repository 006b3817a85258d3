//! Who is still there. A process that dies closes its connections, and the others' collectives fail at once; one that hangs, or
//! whose machine is gone, closes nothing. So every rank gives a sign of life now and then, and one that gives none is told of.
//! Whatever goes wrong, one rank says so for all.

use super::place::Place;
use crate::error::{Error, Result};
use cxx::UniquePtr;
use globalsplat_csrc::ranks as ffi;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex};
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
    /// Dropped, it ends what listens.
    listening: Mutex<Option<Sender<()>>>,
}

/// The words that ranks leave for each other.
mod key {
    /// How often a rank wanted to say what went wrong.
    pub const SPOKEN: &str = "spoken";
    /// Ranks that have ended with a failure.
    pub const FAILED: &str = "failed";
    /// The number of a rank that gives no sign of life, plus 1.
    pub const LOST: &str = "lost";

    pub fn beats(rank: usize) -> String {
        format!("beats/{rank}")
    }

    pub fn left(rank: usize) -> String {
        format!("left/{rank}")
    }
}

impl Watch {
    /// Connects this rank with the others. `end` is called in another thread when the others can't be worked with any more, with a
    /// sentence on why if this rank is to say it; it doesn't return.
    ///
    /// # Errors
    /// A store that can't be reached.
    pub fn begin(place: &Place, end: fn(Option<String>)) -> Result<Self> {
        let serves = !place.store_is_kept && place.rank == 0;
        // A store that torchrun keeps is the same after a restart.
        let round = if place.store_is_kept { place.restarts } else { 0 };
        let store =
            ffi::connect(&place.host, place.port, serves, &format!("globalsplat/{round}"), MEETING_SECONDS);
        let store = store.map_err(|e| {
            let why = e.what().lines().next().unwrap_or_default().to_string();
            let Place { rank, ranks, host, port, .. } = place;
            Error::Failed(format!("rank {rank} of {ranks} can't reach the others at {host}:{port}: {why}"))
        })?;
        let (sender, receiver) = channel();
        let listening = Mutex::new(Some(sender));
        let own = Watch { store: store.another()?, place: place.clone(), listening: Mutex::default() };
        // A store whose machine is gone leaves who asks it waiting, so another thread looks at when it last answered.
        let answered = Arc::new(Mutex::new(Some(Instant::now())));
        let last = answered.clone();
        let listen = move || {
            let mut others = Others::of(&own.place);
            loop {
                match others.lost(&own.store) {
                    Some(why) => return end(own.speak(&why)),
                    None => *last.lock().expect("no thread panics here") = Some(Instant::now()),
                }
                if receiver.recv_timeout(BEAT) != Err(RecvTimeoutError::Timeout) {
                    break;
                }
            }
            *last.lock().expect("no thread panics here") = None;
        };
        let says = place.local_rank == 0;
        let check = move || {
            while let Some(last) = { *answered.lock().expect("no thread panics here") } {
                if last.elapsed() > SILENCE {
                    let seconds = SILENCE.as_secs();
                    let why = format!(
                        "the store through which the processes meet has not answered for {seconds} seconds"
                    );
                    return end(says.then_some(why));
                }
                std::thread::sleep(BEAT);
            }
        };
        for (name, work) in
            [("listen", Box::new(listen) as Box<dyn FnOnce() + Send>), ("check", Box::new(check))]
        {
            let thread = std::thread::Builder::new().name(name.into()).spawn(work);
            thread.map_err(|e| Error::Failed(format!("a thread can't be started: {e}")))?;
        }
        Ok(Watch { store, place: place.clone(), listening })
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
        let speaks = match self.store.add(key::SPOKEN, 1) {
            Ok(times) => times == 1,
            // A store that is gone can't tell who spoke.
            Err(_) => self.place.local_rank == 0,
        };
        let who = match self.place.rank {
            0 => String::new(),
            rank => format!("rank {rank} of {}: ", self.place.ranks),
        };
        speaks.then(|| who + why)
    }

    /// The last that this rank does: from here on its silence means nothing, or that it `failed`, and then the others end, too. Whoever
    /// keeps the store waits until they have heard.
    pub fn leave(&self, failed: bool) {
        let Some(_listening) = self.listening.lock().expect("no thread panics here").take() else { return };
        let left = key::left(self.place.rank);
        let _ = self.store.add(if failed { key::FAILED } else { &left }, 1);
        if !self.place.store_is_kept && self.place.rank == 0 {
            let patience = if failed { 2 * BEAT } else { SILENCE };
            let has_left = |rank| !matches!(self.store.add(&key::left(rank), 0), Ok(0));
            let since = Instant::now();
            while since.elapsed() < patience && !(1..self.place.ranks).all(has_left) {
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

    /// Gives a sign of life, and tells why the others can't be worked with any more, if so.
    fn lost(&mut self, store: &ffi::Store) -> Option<String> {
        match self.listen(store) {
            Ok(found) => found,
            Err(_) => Some("the store through which the processes meet is gone, and who kept it, too".into()),
        }
    }

    fn listen(&mut self, store: &ffi::Store) -> std::result::Result<Option<String>, cxx::Exception> {
        store.add(&key::beats(self.rank), 1)?;
        if store.add(key::FAILED, 0)? > 0 {
            // It has spoken before.
            return Ok(Some("another process has failed".into()));
        }
        let silent = |rank: usize| {
            let (ranks, seconds) = (self.ranks, SILENCE.as_secs());
            Some(format!("rank {rank} of {ranks} gave no sign of life for {seconds} seconds"))
        };
        if let rank @ 1.. = store.add(key::LOST, 0)? {
            return Ok(silent(rank as usize - 1));
        }
        for (rank, beats, last) in &mut self.heard {
            let now = store.add(&key::beats(*rank), 0)?;
            // Machines don't start at the same time.
            let patience = if *beats == 0 { Duration::from_secs(MEETING_SECONDS as u64) } else { SILENCE };
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
