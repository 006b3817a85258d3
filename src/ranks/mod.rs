//! Processes that work on the same thing, each a rank: started by `torchrun`, on one machine or on many, brought together by
//! libtorch's c10d. A program that runs alone is the only rank of its group, and then nothing here does anything.

mod buckets;
mod group;
mod place;
mod watch;

pub use buckets::Buckets;
pub use group::Group;
pub use place::Place;
pub use watch::Watch;
