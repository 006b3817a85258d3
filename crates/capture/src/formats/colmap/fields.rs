//! Parsers of numbers and names in COLMAP's text and binary files, with error messages for invalid values.

use globalsplat_files::{Error, Result};
use std::path::Path;
use std::str::FromStr;

/// Returns `true` if a line of a text file is blank or a comment.
pub fn is_comment(line: &str) -> bool {
    line.trim().is_empty() || line.trim_start().starts_with('#')
}

/// A line that is parsed word by word.
pub struct WordReader<'a> {
    pub file: &'a Path,
    /// Line number, starting at 1.
    pub number: usize,
    pub rest: &'a str,
}

impl WordReader<'_> {
    pub fn parse<T: FromStr>(&mut self, name: &str, expected: &str) -> Result<T> {
        let trimmed = self.rest.trim_start();
        let (word, rest) = trimmed.split_at(trimmed.find(char::is_whitespace).unwrap_or(trimmed.len()));
        self.rest = rest;
        let found = if word.is_empty() { "missing".to_string() } else { format!("{word:?}") };
        let refused = |_| Error::input(self.file, format!("{name} in line {}", self.number), found, expected);
        if word.is_empty() { Err(()) } else { word.parse().map_err(drop) }.map_err(refused)
    }

    /// Reads the numbers `names`.
    pub fn numbers<T: FromStr + Copy + Default, const N: usize>(
        &mut self,
        names: [&str; N],
        expected: &str,
    ) -> Result<[T; N]> {
        let mut numbers = [T::default(); N];
        for (number, name) in numbers.iter_mut().zip(names) {
            *number = self.parse(name, expected)?;
        }
        Ok(numbers)
    }
}

/// A file's contents that are parsed value by value.
pub struct ByteReader<'a> {
    pub file: &'a Path,
    pub contents: &'a [u8],
    pub at: usize,
}

impl ByteReader<'_> {
    pub fn left(&self) -> usize {
        self.contents.len() - self.at
    }

    pub fn take<const N: usize>(&mut self, field: impl FnOnce() -> String) -> Result<[u8; N]> {
        match self.contents[self.at..].first_chunk() {
            Some(chunk) => {
                self.at += N;
                Ok(*chunk)
            }
            None => {
                let found = format!("cut short by the end of the file after {} bytes", self.contents.len());
                Err(Error::input(self.file, field(), found, format!("{N} bytes")))
            }
        }
    }

    pub fn u32(&mut self, field: impl FnOnce() -> String) -> Result<u32> {
        self.take(field).map(u32::from_le_bytes)
    }

    pub fn u64(&mut self, field: impl FnOnce() -> String) -> Result<u64> {
        self.take(field).map(u64::from_le_bytes)
    }

    pub fn numbers<const N: usize>(&mut self, field: impl Fn() -> String) -> Result<[f64; N]> {
        let mut numbers = [0.; N];
        for number in &mut numbers {
            *number = f64::from_le_bytes(self.take(&field)?);
        }
        Ok(numbers)
    }

    /// Skips `count` bytes that are there.
    pub fn skip(&mut self, count: usize) {
        self.at += count;
    }

    /// Reads a number of entries that take at least `smallest` bytes each, and fails if the file can't hold that many.
    pub fn count(&mut self, field: &str, smallest: usize) -> Result<usize> {
        let count = self.u64(|| field.to_string())?;
        let room = self.left() / smallest;
        usize::try_from(count).ok().filter(|&count| count <= room).ok_or_else(|| {
            let expected = format!("{room} at most, for which the file has bytes");
            Error::input(self.file, field, count, expected)
        })
    }

    pub fn name(&mut self, field: impl FnOnce() -> String) -> Result<String> {
        let rest = &self.contents[self.at..];
        let end = rest.iter().position(|&byte| byte == 0);
        match end.and_then(|end| std::str::from_utf8(&rest[..end]).ok()) {
            Some(name) if !name.contains(char::is_control) => {
                self.at += name.len() + 1;
                Ok(name.to_string())
            }
            _ => Err(Error::input(self.file, field(), "no text", "UTF-8 ended by a 0")),
        }
    }

    pub fn end(&self) -> Result<()> {
        match self.left() {
            0 => Ok(()),
            left => {
                let expected = format!("{} as its counts say", self.at);
                Err(Error::input(
                    self.file,
                    "the length",
                    format!("{} bytes, {left} too many", self.contents.len()),
                    expected,
                ))
            }
        }
    }
}
