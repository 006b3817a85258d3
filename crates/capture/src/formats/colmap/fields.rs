//! Parser of COLMAP's text and binary files, which hold the same values in the same order, with error messages for invalid ones.

use globalsplat_files::{Error, Result, read_text};
use std::path::Path;
use std::str::FromStr;

/// A number in a file.
pub trait Number: FromStr + Copy + Default {
    /// Description for error messages.
    const NAME: &'static str;

    /// Reads the number, in little-endian order, at the start of `bytes`, or returns `None` if they are too few.
    fn read(bytes: &[u8]) -> Option<Self>;
}

macro_rules! numbers {
    ($($number:ty: $name:literal),*) => {
        $(impl Number for $number {
            const NAME: &'static str = $name;

            fn read(bytes: &[u8]) -> Option<Self> {
                bytes.first_chunk().map(|bytes| Self::from_le_bytes(*bytes))
            }
        })*
    };
}

numbers!(
    u8: "a whole number from 0 to 255",
    u32: "a whole number",
    i32: "a whole number",
    u64: "a whole number",
    f64: "a number"
);

/// The values of a file, one by one.
pub struct Values<'a> {
    pub file: &'a Path,
    source: Source<'a>,
}

enum Source<'a> {
    /// What is left of the line `number`, counted from 1, and the line after it if that belongs to the same entry, with its number.
    Text { number: usize, rest: &'a str, second: Option<(usize, &'a str)> },
    /// The contents of a binary file, and the position of the next value.
    Binary { contents: &'a [u8], at: usize },
}

/// Reads the entries of `file`, each of which `read_entry` reads, given its index. In a text file, whose extension is `txt`, an entry has
/// `lines` lines. A binary file begins with the number of its entries, which error messages call `count`; each takes at least `smallest` bytes.
///
/// # Errors
/// Fails if the file can't be read or violates the format.
pub fn read_entries<T>(
    file: &Path,
    lines: usize,
    count: &str,
    smallest: usize,
    read_entry: impl Fn(&mut Values, usize) -> Result<T>,
) -> Result<Vec<T>> {
    let mut entries = vec![];
    if file.extension().is_some_and(|extension| extension == "txt") {
        let text = read_text(file)?;
        let mut rows = (1..).zip(text.lines());
        while let Some((number, rest)) = rows.next() {
            if !rest.trim().is_empty() && !rest.trim_start().starts_with('#') {
                let second = if lines > 1 { rows.next() } else { None };
                let source = Source::Text { number, rest, second };
                entries.push(read_entry(&mut Values { file, source }, entries.len())?);
            }
        }
        return Ok(entries);
    }
    let contents = std::fs::read(file).map_err(Error::read(file))?;
    let mut values = Values { file, source: Source::Binary { contents: &contents, at: 0 } };
    for index in 0..values.count(count, smallest)? {
        entries.push(read_entry(&mut values, index)?);
    }
    match values.source {
        Source::Binary { at, .. } if at < contents.len() => {
            let found = format!("{} bytes, {} too many", contents.len(), contents.len() - at);
            Err(Error::input(file, "the length", found, format!("{at} as its counts say")))
        }
        _ => Ok(entries),
    }
}

impl<'a> Values<'a> {
    /// Reads a number. Error messages call it `name` in a text file, and `field` in a binary one.
    pub fn number<T: Number>(&mut self, name: &str, field: impl FnOnce() -> String) -> Result<T> {
        let (contents, at) = match &mut self.source {
            Source::Binary { contents, at } => (contents, at),
            Source::Text { number: line, rest, .. } => {
                let word = next_word(rest);
                return word.parse().map_err(|_| {
                    let found = if word.is_empty() { "missing".to_string() } else { format!("{word:?}") };
                    Error::input(self.file, format!("{name} in line {line}"), found, T::NAME)
                });
            }
        };
        let number = T::read(&contents[*at..]).ok_or_else(|| {
            let found = format!("cut short by the end of the file after {} bytes", contents.len());
            Error::input(self.file, field(), found, format!("{} bytes", size_of::<T>()))
        })?;
        *at += size_of::<T>();
        Ok(number)
    }

    /// Reads the numbers `names`, which `field` names in a binary file.
    pub fn numbers<T: Number, const N: usize>(
        &mut self,
        names: [&str; N],
        field: impl Fn() -> String,
    ) -> Result<[T; N]> {
        let mut numbers = [T::default(); N];
        for (number, name) in numbers.iter_mut().zip(names) {
            *number = self.number(name, &field)?;
        }
        Ok(numbers)
    }

    /// Reads a word of a text file, which is empty at the end of the line. Returns `None` in a binary file.
    pub fn word(&mut self) -> Option<&'a str> {
        match &mut self.source {
            Source::Text { rest, .. } => Some(next_word(rest)),
            Source::Binary { .. } => None,
        }
    }

    /// Returns `true` if the line of a text file has more words.
    pub fn has_words(&self) -> bool {
        matches!(&self.source, Source::Text { rest, .. } if !rest.trim().is_empty())
    }

    /// Reads a name: the rest of a line, which may contain spaces, or what a 0 ends in a binary file.
    pub fn name(&mut self, field: impl FnOnce() -> String) -> Result<String> {
        let (contents, at) = match &mut self.source {
            Source::Text { rest, .. } => return Ok(std::mem::take(rest).trim().to_string()),
            Source::Binary { contents, at } => (&contents[*at..], at),
        };
        let end = contents.iter().position(|&byte| byte == 0);
        match end.and_then(|end| std::str::from_utf8(&contents[..end]).ok()) {
            Some(name) if !name.contains(char::is_control) => {
                *at += name.len() + 1;
                Ok(name.to_string())
            }
            _ => Err(Error::input(self.file, field(), "no text", "UTF-8 ended by a 0")),
        }
    }

    /// Skips a list whose number of entries is `field`, each of `size` bytes: the end of a line of a text file, or its second line, in which an
    /// entry is a point of three words.
    pub fn skip_list(&mut self, field: impl FnOnce() -> String, size: usize) -> Result<()> {
        if let Source::Text { second, .. } = self.source {
            // This detects a missing second line, because an image's own line has ten words.
            let (number, words) =
                second.map_or((0, 0), |(number, line)| (number, line.split_whitespace().count()));
            return match words % 3 {
                0 => Ok(()),
                _ => {
                    let expected = "X, Y and POINT3D_ID of each point, or an empty line";
                    let field = format!("POINTS2D in line {number}");
                    Err(Error::input(self.file, field, format!("{words} words"), expected))
                }
            };
        }
        let skipped = self.count(&field(), size)? * size;
        if let Source::Binary { at, .. } = &mut self.source {
            *at += skipped;
        }
        Ok(())
    }

    /// Reads a number of entries that take at least `smallest` bytes each, and fails if the file can't hold that many.
    fn count(&mut self, field: &str, smallest: usize) -> Result<usize> {
        let count: u64 = self.number(field, || field.to_string())?;
        let room = match &self.source {
            Source::Binary { contents, at } => (contents.len() - at) / smallest,
            Source::Text { .. } => 0,
        };
        usize::try_from(count).ok().filter(|&count| count <= room).ok_or_else(|| {
            let expected = format!("{room} at most, for which the file has bytes");
            Error::input(self.file, field, count, expected)
        })
    }
}

/// Takes the next word off a line, which is empty at its end.
fn next_word<'a>(rest: &mut &'a str) -> &'a str {
    let trimmed = rest.trim_start();
    let (word, after) = trimmed.split_at(trimmed.find(char::is_whitespace).unwrap_or(trimmed.len()));
    *rest = after;
    word
}
