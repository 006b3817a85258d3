//! Evaluations on the page, with their names and colours.

use super::super::evaluation::Evaluation;
use super::super::published::{DATASETS, known_dataset};
use std::path::{Path, PathBuf};

/// Number of colours for measured results in the style sheet. Further entries start again with the first colour.
const COLOURS: usize = 6;

/// One evaluation on the page.
pub struct Entry<'a> {
    pub folder: &'a Path,
    pub evaluation: &'a Evaluation,
    /// Name of the method, followed by the folder if several evaluations would have the same name.
    pub name: String,
    /// Key of the dataset: `re10k`, `acid`, `dl3dv`, or the name in the evaluation if it isn't a known one.
    pub dataset: String,
    /// CSS class of the colour. It depends on the name alone, so that a method has the same colour for all datasets and view counts.
    pub colour: String,
}

/// Creates the entries of `evaluations`, in the same order.
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

/// Returns the name of a dataset for readers.
pub fn dataset_name(key: &str) -> &str {
    DATASETS.iter().find(|(file, _)| *file == key).map_or(key, |(_, people)| people)
}

impl Entry<'_> {
    /// Returns the number of scenes that were scored.
    pub fn scored(&self) -> usize {
        self.evaluation.scenes.len()
    }

    /// Returns `true` if the means are over all scenes that the index names.
    pub fn is_whole(&self) -> bool {
        self.scored() >= self.evaluation.indexed_scenes
    }

    /// Returns the dataset and the number of context views, as text.
    pub fn setting(&self) -> String {
        format!("{}, {} context views", dataset_name(&self.dataset), self.evaluation.context_views)
    }
}
