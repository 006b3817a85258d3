//! A file of lines that another process adds to.

use crate::error::{Error, Result};
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Bytes by which the file is known again.
const REMEMBERED: usize = 256;

/// What is new in the file.
#[derive(Debug)]
pub(super) enum News<'a> {
    /// The file is another one than before, or gone: its lines come from the first one on.
    Anew,
    /// A whole line.
    Line(&'a [u8]),
}

/// A file that is read from where it was left.
#[derive(Debug)]
pub(super) struct NewLines {
    path: PathBuf,
    /// Behind the last whole line that was read.
    position: u64,
    /// What stands before `position`. A run that is resumed makes the file shorter, but it may have grown past `position`
    /// again before anybody looks.
    before: Vec<u8>,
    /// When the file was last written.
    pub written: Option<SystemTime>,
}

impl NewLines {
    /// Of the file at `path`, which may not be there yet.
    pub fn new(path: &Path) -> Self {
        NewLines { path: path.to_owned(), position: 0, before: vec![], written: None }
    }

    /// Tells what is new. A line that isn't ended is left for the next time.
    ///
    /// # Errors
    /// The system's refusal.
    pub fn read(&mut self, mut tell: impl FnMut(News)) -> Result<()> {
        let file = match File::open(&self.path) {
            Err(e) if e.kind() == ErrorKind::NotFound => {
                if self.position > 0 {
                    *self = NewLines::new(&self.path);
                    tell(News::Anew);
                }
                return Ok(());
            }
            file => file.map_err(Error::read(&self.path))?,
        };
        self.written = file.metadata().and_then(|file| file.modified()).ok();
        let mut file = BufReader::new(file);
        if !self.knows(&mut file).map_err(Error::read(&self.path))? {
            (self.position, self.before) = (0, vec![]);
            tell(News::Anew);
        }
        file.seek(SeekFrom::Start(self.position)).map_err(Error::read(&self.path))?;
        let mut line = vec![];
        while file.read_until(b'\n', &mut line).map_err(Error::read(&self.path))? > 0 && line.ends_with(b"\n")
        {
            self.position += line.len() as u64;
            self.before.clear();
            self.before.extend(&line[line.len().saturating_sub(REMEMBERED)..]);
            tell(News::Line(&line));
            line.clear();
        }
        Ok(())
    }

    /// Whether what was read last still stands where it stood.
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
    fn lines_are_told_once_until_the_file_is_another() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        let mut lines = NewLines::new(&path);
        let mut news = || {
            let mut told = String::new();
            lines
                .read(|news| match news {
                    News::Anew => told.push('!'),
                    News::Line(line) => told += std::str::from_utf8(line).unwrap(),
                })
                .unwrap();
            told.replace('\n', " ")
        };
        assert_eq!(news(), "");
        for (text, told) in [
            ("1\n2\n3", "1 2 "),
            ("1\n2\n34\n", "34 "),
            ("1\n2\n34\n", ""),
            ("1\n2\n", "!1 2 "),
            // Shorter, and longer than before when it is looked at again.
            ("1\n9\n5\n6\n", "!1 9 5 6 "),
        ] {
            std::fs::write(&path, text).unwrap();
            assert_eq!(news(), told, "{text:?}");
        }
        std::fs::remove_file(&path).unwrap();
        assert_eq!((news(), news()), ("!".into(), "".into()));
    }
}
