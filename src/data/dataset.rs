//! Datasets: many captures under one name (spec 10.8).

use crate::error::{Error, Result};
use crate::io::{InputFiles, read_text, real_path, relative_name};
use globalsplat_capture::{
    CHUNK_INDEX_FILE, Capture, Chunk, FoundCaptures, find_captures, folder_name, is_capture, open_capture,
};
use globalsplat_synth::SyntheticDataset;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Part of a dataset: the one to train on or the one to evaluate on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Split {
    /// The folder `train`.
    Train,
    /// The folder `test`.
    Test,
}

impl Split {
    /// Returns the name of the folder of this part, and of the folder of the other one.
    fn folders(self) -> [&'static str; 2] {
        match self {
            Split::Train => ["train", "test"],
            Split::Test => ["test", "train"],
        }
    }
}

/// Captures that are read from disk together, and their names.
#[derive(Debug, Clone)]
pub struct SceneGroup {
    /// Path as returned by [`SceneGroup::path`].
    path: PathBuf,
    source: Source,
    /// Keys of the chunk's scenes that belong to the dataset. For a folder, its name, or its path if another folder has the same
    /// name.
    pub keys: Vec<String>,
}

/// Source that scenes are read from.
#[derive(Debug, Clone)]
enum Source {
    /// A file with one or more scenes.
    Chunk,
    /// A capture of another format.
    Folder,
    /// The synthetic video of this index.
    SyntheticDataset(Arc<SyntheticDataset>, usize),
}

/// The captures of one split. They are located when the dataset is opened and read later.
#[derive(Debug, Clone)]
pub struct Dataset {
    /// Name of the folder.
    pub name: String,
    /// All groups, ordered by path.
    pub groups: Vec<SceneGroup>,
    /// A line for each folder that couldn't be read.
    pub warnings: Vec<String>,
}

/// A group in memory, with images still encoded.
#[derive(Debug, Clone)]
pub enum OpenGroup {
    /// Scenes of a chunk.
    Chunk(Chunk),
    /// A capture of another format.
    Capture(Box<Capture>),
}

impl Dataset {
    /// Opens the dataset at `root`, one of the following:
    ///
    /// - synthetic videos, by their name;
    /// - a folder of chunks with an `index.json`, {key: chunk};
    /// - a folder with such folders named `train` and `test`, of which `split` is taken;
    /// - a folder of captures: all that [`super::find_captures`] finds, except those in the folder of the other split.
    ///
    /// # Errors
    /// Fails if there is nothing of that kind at `root`, or if the index is not such an object. Chunks named by the index are not
    /// looked for until they are opened.
    pub fn open(root: &Path, split: Split) -> Result<Self> {
        if let Some(videos) = SyntheticDataset::named(root)? {
            let name = root.to_string_lossy().into_owned();
            return Ok(Dataset { name, groups: synthetic_groups(videos), warnings: vec![] });
        }
        let name = folder_name(root);
        let [part, other] = split.folders().map(|folder| root.join(folder));
        let indexed = [root, &part].into_iter().find(|folder| folder.join(CHUNK_INDEX_FILE).is_file());
        let (groups, warnings) = match indexed {
            Some(folder) => (chunk_groups(folder)?, vec![]),
            // A capture may keep its photos in a folder of that name.
            None if part.is_dir() && !is_capture(root) => capture_groups(&part, &other)?,
            None => capture_groups(root, &other)?,
        };
        Ok(Dataset { name, groups, warnings })
    }

    /// Returns what synthetic videos depend on besides their name: the version of their generator. Returns `None` for other datasets.
    pub fn generator(&self) -> Option<&str> {
        let is_synthetic = matches!(self.groups.first()?.source, Source::SyntheticDataset(..));
        is_synthetic.then_some(SyntheticDataset::GENERATOR)
    }

    /// Adds to `inputs` the files of the dataset that writing below the folder `output` could overwrite.
    pub fn add_input_files(&self, output: &Path, inputs: &mut InputFiles) {
        self.groups.iter().for_each(|group| group.add_input_files(output, inputs));
    }

    /// Returns the number of scenes.
    pub fn scenes(&self) -> usize {
        self.groups.iter().map(|group| group.keys.len()).sum()
    }
}

impl SceneGroup {
    /// Reads the group.
    ///
    /// # Errors
    /// Fails if a chunk or capture is missing or broken.
    pub fn open(&self) -> Result<OpenGroup> {
        match &self.source {
            Source::Chunk => Ok(OpenGroup::Chunk(Chunk::read(&self.path)?)),
            Source::Folder => Ok(OpenGroup::Capture(Box::new(open_capture(&self.path)?))),
            Source::SyntheticDataset(videos, index) => {
                Ok(OpenGroup::Capture(Box::new(videos.capture(*index)?)))
            }
        }
    }

    /// Adds to `inputs` the files of the group that writing below the folder `output` could overwrite. Adds none of a capture that
    /// can't be opened; opening it elsewhere reports the error.
    pub fn add_input_files(&self, output: &Path, inputs: &mut InputFiles) {
        match &self.source {
            Source::Chunk => {
                inputs.add(&self.path);
                inputs.add(&self.path.with_file_name(CHUNK_INDEX_FILE));
            }
            Source::Folder => {
                let (folder, output) = (real_path(&self.path), real_path(output));
                if (folder.starts_with(&output) || output.starts_with(&folder))
                    && let Ok(capture) = open_capture(&self.path)
                {
                    capture.add_input_files(inputs);
                }
            }
            Source::SyntheticDataset(..) => {}
        }
    }

    /// Returns `true` if the group is a capture's folder. Once open, such a capture holds little more than its cameras.
    pub fn is_folder(&self) -> bool {
        matches!(self.source, Source::Folder)
    }

    /// Returns the path of the chunk or of the capture's folder. All synthetic videos share one path; their keys tell them apart.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl OpenGroup {
    /// Returns the scene `key`.
    ///
    /// # Errors
    /// Fails if the scene doesn't exist or violates the requirements on captures.
    pub fn capture(&self, key: &str) -> Result<Capture> {
        match self {
            OpenGroup::Chunk(chunk) => Ok(chunk.capture(key)?),
            OpenGroup::Capture(capture) => Ok(Capture::clone(capture)),
        }
    }
}

fn chunk_groups(folder: &Path) -> Result<Vec<SceneGroup>> {
    let file = folder.join(CHUNK_INDEX_FILE);
    let index: BTreeMap<String, String> = serde_json::from_str(&read_text(&file)?).map_err(|e| {
        Error::input(&file, "the index", format!("unusable ({e})"), "{scene: chunk's file name}")
    })?;
    let mut chunks: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for (key, chunk) in index {
        let plain = Path::new(&chunk).file_name().is_some_and(|name| name == chunk.as_str());
        if !plain {
            return Err(Error::input(
                &file,
                format!("the chunk of {key}"),
                chunk,
                "the name of a file in the same folder",
            ));
        }
        chunks.entry(chunk).or_default().push(key);
    }
    let group = |(chunk, keys)| SceneGroup { path: folder.join(chunk), source: Source::Chunk, keys };
    Ok(chunks.into_iter().map(group).collect())
}

fn synthetic_groups(videos: SyntheticDataset) -> Vec<SceneGroup> {
    let videos = Arc::new(videos);
    let group = |(index, key)| SceneGroup {
        path: PathBuf::from(SyntheticDataset::PREFIX),
        source: Source::SyntheticDataset(videos.clone(), index),
        keys: vec![key],
    };
    videos.keys().into_iter().enumerate().map(group).collect()
}

/// Returns the captures in `root` except those in `except`, and warnings about folders that couldn't be read.
fn capture_groups(root: &Path, except: &Path) -> Result<(Vec<SceneGroup>, Vec<String>)> {
    let FoundCaptures { paths: mut folders, warnings } = find_captures(root)?;
    folders.retain(|folder| !folder.starts_with(except));
    if folders.is_empty() {
        let found = format!("a folder whose captures are all in {}", except.display());
        return Err(Error::input(
            root,
            "the folder",
            found,
            "captures outside the folder of the other split",
        ));
    }
    let names: Vec<String> = folders.iter().map(|folder| folder_name(folder)).collect();
    let mut counts: BTreeMap<&String, usize> = BTreeMap::new();
    names.iter().for_each(|name| *counts.entry(name).or_default() += 1);
    // Folders with the same name are told apart by their paths below the root.
    let key = |folder: &Path, name: &String| match counts[name] {
        1 => name.clone(),
        _ => relative_name(folder, root),
    };
    let keys: Vec<String> = folders.iter().zip(&names).map(|(folder, name)| key(folder, name)).collect();
    let group = |(path, key)| SceneGroup { path, source: Source::Folder, keys: vec![key] };
    Ok((folders.into_iter().zip(keys).map(group).collect(), warnings))
}
