//! Tests of files that torch writes and reads, of pickles, and of what is refused in them.

mod pickles;
mod reading;
mod refusals;
mod writing;
