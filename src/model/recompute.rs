//! Activation checkpointing: an encoder pass that keeps of every round only what it began with, and computes the round again
//! when its gradient is due.

use super::encoder::{Encoded, Encoder, Slots};
use super::leaves::{leaf, pull_back};
use super::memory::Memory;
use tch::{Tensor, no_grad};

/// What is left of an encoder's forward pass for its backward pass.
#[derive(Debug)]
pub(crate) struct KeptRounds<'a> {
    encoder: &'a Encoder,
    /// Before the first round, with their way back to scene tokens and image tokens.
    slots: Slots,
    memory: Memory,
    /// All rounds read the same memory, so its gradient is the sum of theirs.
    memory_leaf: Memory,
    /// Before every round, and after the last one.
    between: Vec<Slots>,
}

impl Encoder {
    /// As [`Encoder::forward`]. The result's gradients are to be followed first, then [`KeptRounds::backward`].
    pub(crate) fn forward_keeping_rounds(
        &self,
        scene_tokens: &Tensor,
        memory: Memory,
    ) -> (Encoded, KeptRounds<'_>) {
        let slots = self.start(scene_tokens, memory.common.size()[0]);
        let memory_leaf = memory.leaf();
        let mut between = vec![slots.map(leaf)];
        for round in 0..self.rounds() {
            let after = no_grad(|| self.round(round, &between[round], &memory_leaf));
            between.push(after.map(leaf));
        }
        let encoded = self.decoded(between.last().expect("one more than rounds"));
        (encoded, KeptRounds { encoder: self, slots, memory, memory_leaf, between })
    }
}

impl KeptRounds<'_> {
    /// From the last round to the first, then into what they began with.
    pub fn backward(mut self) {
        for round in (0..self.encoder.rounds()).rev() {
            let after = self.between.pop().expect("one more than rounds");
            let again = self.encoder.round(round, &self.between[round], &self.memory_leaf);
            pull_back(&again.beside(&after));
        }
        let mut start = self.slots.beside(&self.between[0]);
        start.push((&self.memory.tokens, &self.memory_leaf.tokens));
        pull_back(&start);
    }
}
