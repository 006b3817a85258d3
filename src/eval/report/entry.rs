//! What was measured, and how the page calls and colours it.

use super::super::evaluation::Evaluation;
use super::super::published::{DATASETS, known_dataset};
use std::path::{Path, PathBuf};

/// Colours that the style sheet has for what was measured; further ones begin again.
const COLOURS: usize = 6;

/// One evaluation on the page.
pub struct Entry<'a> {
    pub folder: &'a Path,
    pub evaluation: &'a Evaluation,
    /// The method, and the folder where that alone doesn't tell it from another.
    pub name: String,
    /// `re10k`, `acid`, `dl3dv`, or another name as it was found.
    pub dataset: String,
    /// Class that gives it its colour: one for each name, so that a method keeps its own over data sets and view counts.
    pub colour: String,
}

/// In the order given.
pub fn entries(evaluations: &[(PathBuf, Evaluation)]) -> Vec<Entry<'_>> {
    let mut names: Vec<String> = vec![];
    let mut entries = vec![];
    for (folder, evaluation) in evaluations {
        let same = |other: &Evaluation| {
            (&other.method, dataset_key(&other.dataset), other.context_views)
                == (&evaluation.method, dataset_key(&evaluation.dataset), evaluation.context_views)
        };
        let alone = evaluations.iter().filter(|(_, other)| same(other)).count() == 1;
        let name = match alone {
            true => evaluation.method.clone(),
            false => format!("{} ({})", evaluation.method, folder.display()),
        };
        let position = names.iter().position(|n| *n == name).unwrap_or_else(|| {
            names.push(name.clone());
            names.len() - 1
        });
        entries.push(Entry {
            folder,
            evaluation,
            name,
            dataset: dataset_key(&evaluation.dataset),
            colour: format!("colour-{}", position % COLOURS + 1),
        });
    }
    entries
}

fn dataset_key(name: &str) -> String {
    known_dataset(name).map_or(name.into(), String::from)
}

/// A data set as people call it.
pub fn dataset_name(key: &str) -> &str {
    DATASETS.iter().find(|(file, _)| *file == key).map_or(key, |(_, people)| people)
}

impl Entry<'_> {
    /// Scenes that were scored.
    pub fn scored(&self) -> usize {
        self.evaluation.scenes.len()
    }

    /// Whether the mean is of all scenes that the index names.
    pub fn is_whole(&self) -> bool {
        self.scored() >= self.evaluation.indexed_scenes
    }

    /// Data set and number of context views.
    pub fn setting(&self) -> String {
        format!("{}, {} context views", dataset_name(&self.dataset), self.evaluation.context_views)
    }
}
