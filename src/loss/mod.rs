//! Losses (SPEC section 7), one file per term.

mod decoder_regularization;

pub use decoder_regularization::{decoder_regularization, sh_soft_cap};
