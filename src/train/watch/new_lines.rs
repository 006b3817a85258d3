//! Reader of a text file that another process appends lines to.

use crate::error::{Error, Result};
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Maximum number of bytes that are compared to check that the file is still the same.
const REMEMBERED: usize = 256;

/// Change of the file since the last read.
#[derive(Debug)]
pub(super) enum FileChange<'a> {
    /// The file was replaced or removed. Its lines follow from the first one on.
    Replaced,
    /// A complete line.
    Line(&'a [u8]),
}

/// File that is read from where the last read ended.
#[derive(Debug)]
pub(super) struct NewLines {
    path: PathBuf,
    /// Offset of the end of the last complete line that was read.
    position: u64,
    /// Bytes before `position`, at most [`REMEMBERED`]. A resumed run truncates the file, but the file may have grown past `position` again
    /// before the next read.
    before: Vec<u8>,
    /// Time at which the file was last written.
    pub written: Option<SystemTime>,
}

impl NewLines {
    /// Creates a reader of the file at `path`, which may not exist yet.
    pub fn new(path: &Path) -> Self {
        NewLines { path: path.to_owned(), position: 0, before: vec![], written: None }
    }

    /// Reads what is new in the file and passes it to `tell`. An incomplete line is left for the next read.
    ///
    /// # Errors
    /// Returns an error if the file can't be read.
    pub fn read(&mut self, mut tell: impl FnMut(FileChange)) -> Result<()> {
        let file = match File::open(&self.path) {
            Err(e) if e.kind() == ErrorKind::NotFound => {
                if self.position > 0 {
                    *self = NewLines::new(&self.path);
                    tell(FileChange::Replaced);
                }
                return Ok(());
            }
            file => file.map_err(Error::read(&self.path))?,
        };
        self.written = file.metadata().and_then(|file| file.modified()).ok();
        let mut file = BufReader::new(file);
        if !self.knows(&mut file).map_err(Error::read(&self.path))? {
            (self.position, self.before) = (0, vec![]);
            tell(FileChange::Replaced);
        }
        file.seek(SeekFrom::Start(self.position)).map_err(Error::read(&self.path))?;
        let mut line = vec![];
        while file.read_until(b'\n', &mut line).map_err(Error::read(&self.path))? > 0 && line.ends_with(b"\n")
        {
            self.position += line.len() as u64;
            self.before.clear();
            self.before.extend(&line[line.len().saturating_sub(REMEMBERED)..]);
            tell(FileChange::Line(&line));
            line.clear();
        }
        Ok(())
    }

    /// Returns `true` if the bytes before `position` are still those that were read.
    fn knows(&self, file: &mut BufReader<File>) -> std::io::Result<bool> {
        file.seek(SeekFrom::Start(self.position - self.before.len() as u64))?;
        let mut found = vec![];
        file.take(self.before.len() as u64).read_to_end(&mut found)?;
        Ok(found == self.before)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_read_once_until_the_file_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        let mut lines = NewLines::new(&path);
        let mut news = || {
            let mut text = String::new();
            lines
                .read(|news| match news {
                    FileChange::Replaced => text.push('!'),
                    FileChange::Line(line) => text += std::str::from_utf8(line).unwrap(),
                })
                .unwrap();
            text.replace('\n', " ")
        };
        assert_eq!(news(), "");
        for (text, expected) in [
            ("1\n2\n3", "1 2 "),
            ("1\n2\n34\n", "34 "),
            ("1\n2\n34\n", ""),
            ("1\n2\n", "!1 2 "),
            // Truncated, and then longer than before by the next read.
            ("1\n9\n5\n6\n", "!1 9 5 6 "),
        ] {
            std::fs::write(&path, text).unwrap();
            assert_eq!(news(), expected, "{text:?}");
        }
        std::fs::remove_file(&path).unwrap();
        assert_eq!((news(), news()), ("!".into(), "".into()));
    }
}
