//! Activation checkpointing: an encoder pass that stores only the input of every round and recomputes the round in the backward pass.

use super::autograd::{backward_from_grads, leaf};
use super::encoder::{EncodedTokens, Encoder, Slots};
use super::memory::Memory;
use tch::{Tensor, no_grad};

/// State that the backward pass needs from the encoder's forward pass.
#[derive(Debug)]
pub(crate) struct CheckpointedRounds<'a> {
    encoder: &'a Encoder,
    /// Slots before the first round, attached to the graph of scene tokens and image tokens.
    slots: Slots,
    memory: Memory,
    /// Detached memory. All rounds read it, so it accumulates the sum of their gradients.
    memory_leaf: Memory,
    /// Detached slots before every round, and after the last one.
    between: Vec<Slots>,
}

impl Encoder {
    /// Runs [`Encoder::forward`] with activation checkpointing. Run the backward pass of the result first, then
    /// [`CheckpointedRounds::backward`].
    pub(crate) fn forward_checkpointed(
        &self,
        scene_tokens: &Tensor,
        memory: Memory,
    ) -> (EncodedTokens, CheckpointedRounds<'_>) {
        let slots = self.start(scene_tokens, memory.common.size()[0]);
        let memory_leaf = memory.leaf();
        let mut between = vec![slots.map(leaf)];
        for round in 0..self.rounds() {
            let after = no_grad(|| self.round(round, &between[round], &memory_leaf, &|| ()));
            between.push(after.map(leaf));
        }
        let encoded = self.decoded(between.last().expect("one more than rounds"));
        (encoded, CheckpointedRounds { encoder: self, slots, memory, memory_leaf, between })
    }
}

impl CheckpointedRounds<'_> {
    /// Runs the backward pass from the last round to the first, then through the initial slots and the memory.
    pub fn backward(mut self) {
        for round in (0..self.encoder.rounds()).rev() {
            let after = self.between.pop().expect("one more than rounds");
            let again = self.encoder.round(round, &self.between[round], &self.memory_leaf, &|| ());
            backward_from_grads(&again.zip_tensors(&after));
        }
        let mut start = self.slots.zip_tensors(&self.between[0]);
        start.push((&self.memory.tokens, &self.memory_leaf.tokens));
        backward_from_grads(&start);
    }
}
