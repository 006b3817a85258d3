//! Scenes that can't be trained on: counted, skipped, and refused when there are too many of them.

use super::order::Place;
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt;
use std::sync::Mutex;

/// What is wrong with a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Fault {
    /// The file that it lies in, together with others.
    Group,
    /// Its cameras, or anything else that all its views share.
    Scene,
    /// Shorter than the shortest window.
    Short,
    /// An image.
    Image,
}

/// Scenes that were skipped so far, each counted once.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct BadData {
    /// Of these.
    pub scenes: u64,
    /// In files that can't be read.
    pub in_broken_files: u64,
    /// With cameras that can't be used.
    pub broken: u64,
    /// Shorter than the shortest window.
    pub too_short: u64,
    /// With images that can't be read.
    pub with_broken_images: u64,
    /// What was wrong with the first of them that was more than too short.
    pub first: Option<String>,
}

impl BadData {
    /// Scenes that were skipped.
    pub fn total(&self) -> u64 {
        self.in_broken_files + self.broken + self.too_short + self.with_broken_images
    }
}

/// One line.
impl fmt::Display for BadData {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let kinds = [
            (self.too_short, "too short"),
            (self.in_broken_files, "in broken files"),
            (self.broken, "with broken cameras"),
            (self.with_broken_images, "with broken images"),
        ];
        let found = kinds.iter().filter(|(count, _)| *count > 0);
        let found: Vec<String> = found.map(|(count, kind)| format!("{count} {kind}")).collect();
        write!(f, "{} of {} scenes were skipped: {}", self.total(), self.scenes, found.join(", "))?;
        match &self.first {
            Some(first) => write!(f, "; the first: {first}"),
            None => Ok(()),
        }
    }
}

/// Scenes that were found bad together, for other processes to count.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct News {
    fault: Fault,
    places: Vec<Place>,
    why: String,
}

/// Keeps [`BadData`] for all threads.
#[derive(Debug)]
pub(super) struct Ledger {
    largest_share: f64,
    entries: Mutex<Entries>,
}

#[derive(Debug, Default)]
struct Entries {
    counts: BadData,
    seen: BTreeSet<Place>,
    /// What was wrong with the last one that was found.
    last: Option<String>,
    /// What was found here since somebody asked.
    news: Vec<News>,
}

/// One line.
impl fmt::Display for Entries {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}", self.counts)?;
        match &self.last {
            // Of broken ones the first is named.
            Some(last) if self.counts.first.is_none() => write!(f, "; the last: {last}"),
            _ => Ok(()),
        }
    }
}

impl Ledger {
    /// For `scenes`, of which `largest_share` may be bad.
    pub fn new(scenes: u64, largest_share: f64) -> Self {
        let counts = BadData { scenes, ..Default::default() };
        Ledger { largest_share, entries: Mutex::new(Entries { counts, ..Default::default() }) }
    }

    /// Counts `places`, once each.
    ///
    /// # Errors
    /// Too many.
    pub fn add(
        &self,
        fault: Fault,
        places: impl Iterator<Item = Place>,
        why: impl fmt::Display,
    ) -> Result<()> {
        let mut entries = self.entries.lock().expect("no thread panics here");
        let places: Vec<Place> = places.filter(|place| !entries.seen.contains(place)).collect();
        if places.is_empty() {
            return Ok(());
        }
        // Decoders break lines.
        let news = News { fault, places, why: why.to_string().replace('\n', " ") };
        entries.news.push(news.clone());
        self.count(&mut entries, news)
    }

    /// Counts what another process has found.
    ///
    /// # Errors
    /// Too many.
    pub fn hear(&self, news: News) -> Result<()> {
        self.count(&mut self.entries.lock().expect("no thread panics here"), news)
    }

    fn count(&self, entries: &mut Entries, News { fault, places, why }: News) -> Result<()> {
        let Entries { counts, seen, last, .. } = entries;
        let new = places.into_iter().filter(|&place| seen.insert(place)).count() as u64;
        if new == 0 {
            return Ok(());
        }
        *match fault {
            Fault::Group => &mut counts.in_broken_files,
            Fault::Scene => &mut counts.broken,
            Fault::Short => &mut counts.too_short,
            Fault::Image => &mut counts.with_broken_images,
        } += new;
        if fault != Fault::Short {
            counts.first.get_or_insert_with(|| why.clone());
        }
        *last = Some(why);
        if counts.total() as f64 > self.largest_share * counts.scenes as f64 {
            let share = self.largest_share;
            return Err(Error::Failed(format!("{entries}; data.max_bad_share allows {share} of them")));
        }
        Ok(())
    }

    pub fn has_news(&self) -> bool {
        !self.entries.lock().expect("no thread panics here").news.is_empty()
    }

    pub fn take_news(&self) -> Vec<News> {
        std::mem::take(&mut self.entries.lock().expect("no thread panics here").news)
    }

    /// That there is nothing left.
    pub fn exhausted(&self) -> Error {
        let entries = self.entries.lock().expect("no thread panics here");
        Error::Failed(format!("no scene can be trained on: {entries}"))
    }

    pub fn counts(&self) -> BadData {
        self.entries.lock().expect("no thread panics here").counts.clone()
    }
}
