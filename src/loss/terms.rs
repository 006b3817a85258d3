//! The terms of the loss. Each is named in one list: sums, logs and TensorBoard go through [`Term::ALL`].

use super::config::LossConfig;
use std::ops::Index;
use tch::{Kind, Tensor, no_grad};

/// Declares [`Term`] from a list, so that each has its name and its place by being in it.
macro_rules! terms {
    ($($(#[$meta:meta])* $term:ident $name:literal)*) => {
        /// A term of the loss, or a part of one that is told by itself.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum Term {
            $($(#[$meta])* $term),*
        }

        impl Term {
            /// In the order in which they are summed and told.
            pub const ALL: [Term; [$($name),*].len()] = [$(Term::$term),*];

            /// What logs call it.
            pub fn name(self) -> &'static str {
                match self {
                    $(Term::$term => $name),*
                }
            }
        }
    };
}

terms! {
    /// Mean squared error of the rendered colours.
    Mse "mse"
    /// L_perc; 0 where it is left out.
    Perceptual "perceptual"
    /// L_con, with its factors; 0 where the sample isn't paired.
    Consistency "consistency"
    /// L_fru.
    Frustum "frustum"
    /// L_dec, the sum of the parts that follow, with its own factor.
    Decoder "decoder"
    /// L_opacity; 0 where it is left out.
    DecoderOpacity "decoder_opacity"
    /// L_scale.
    DecoderScale "decoder_scale"
    /// L_rot.
    DecoderRotation "decoder_rotation"
    /// L_SH.
    DecoderSh "decoder_sh"
}

impl Term {
    /// What it counts in the sum; none for a part of another term.
    pub fn factor(self, config: &LossConfig) -> Option<f64> {
        match self {
            Term::Mse => Some(config.mse),
            Term::Perceptual => Some(config.perceptual_factor),
            Term::Consistency => Some(1.),
            Term::Frustum => Some(config.frustum),
            Term::Decoder => Some(config.decoder),
            Term::DecoderOpacity | Term::DecoderScale | Term::DecoderRotation | Term::DecoderSh => None,
        }
    }
}

/// The loss and its terms before their factors: scalar tensors, or numbers.
#[derive(Debug, Clone, Copy, Default)]
pub struct Losses<T> {
    /// What is minimized.
    pub total: T,
    terms: [T; Term::ALL.len()],
}

impl Losses<Tensor> {
    /// What `term` gives for every term, and the sum of those that count by the factors of `config`.
    pub fn weighted(config: &LossConfig, term: impl Fn(Term) -> Tensor) -> Self {
        let terms = Term::ALL.map(term);
        let counted = Term::ALL.iter().zip(&terms).filter_map(|(of, term)| Some(term * of.factor(config)?));
        let total = counted.reduce(|sum, term| sum + term).expect("terms that count");
        Losses { total, terms }
    }

    /// Their values, the sum before the terms, in one tensor: to be added up over slices of a step, and read at once. In float64,
    /// in which sums lose nothing.
    pub fn packed(&self) -> Tensor {
        let all: Vec<&Tensor> = std::iter::once(&self.total).chain(&self.terms).collect();
        no_grad(|| Tensor::stack(&all, 0).to_kind(Kind::Double))
    }
}

impl Losses<f64> {
    /// As many numbers as [`Losses::packed`] puts together.
    pub const COUNT: usize = 1 + Term::ALL.len();

    /// What [`Losses::packed`] put together.
    pub fn unpacked(values: &[f64; Self::COUNT]) -> Self {
        Losses { total: values[0], terms: std::array::from_fn(|term| values[1 + term]) }
    }
}

impl<T> Index<Term> for Losses<T> {
    type Output = T;

    fn index(&self, term: Term) -> &T {
        &self.terms[term as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_term_has_its_own_place_and_name() {
        let config =
            LossConfig { mse: 2., perceptual_factor: 3., frustum: 5., decoder: 7., ..Default::default() };
        let tensors = Losses::weighted(&config, |term| Tensor::from(term as usize as f64));
        let twice = tensors.packed() * 2.;
        let values = Vec::<f64>::try_from(twice).expect("numbers").try_into().expect("one of each");
        let sum = Losses::unpacked(&values);
        assert_eq!(sum.total, 2. * (2. * 0. + 3. * 1. + 2. + 5. * 3. + 7. * 4.));
        for (place, term) in Term::ALL.into_iter().enumerate() {
            assert_eq!((term as usize, sum[term]), (place, 2. * place as f64), "{}", term.name());
            assert_eq!(Term::ALL.iter().filter(|other| other.name() == term.name()).count(), 1);
        }
    }
}
