//! The encoder: a fixed set of scene tokens attends to every view, in two streams (spec 4.1).

use super::autograd::tracks_grad;
use super::config::{ModelConfig, Streams};
use super::layers::{ENCODER_STD, layer_norm, linear, normalize, randn};
use super::memory::Memory;
use super::mixer::Mixer;
use super::precision::Precision;
use super::stream::{REGISTERS, StreamRound};
use tch::{Tensor, nn};
use tracing::trace_span;

/// Number of auxiliary query tokens before the scene tokens; they are not decoded.
const AUXILIARIES: i64 = 4;
/// Number of learned tokens at the start of the memory.
const MEMORY_REGISTERS: i64 = 4;

/// Scene tokens that have attended to every view, [B, M, d] each. With a single stream both fields are the same tensor.
#[derive(Debug)]
pub struct EncodedTokens {
    /// Tokens from which positions, scales, rotations, opacities and the gate are decoded.
    pub geometry: Tensor,
    /// Tokens from which colours are decoded.
    pub appearance: Tensor,
}

impl EncodedTokens {
    /// Applies `f` to both tensors.
    pub(crate) fn map(&self, f: impl Fn(&Tensor) -> Tensor) -> Self {
        EncodedTokens { geometry: f(&self.geometry), appearance: f(&self.appearance) }
    }

    /// Pairs both tensors with the corresponding ones of `other`.
    pub(crate) fn zip_tensors<'a>(&'a self, other: &'a EncodedTokens) -> [(&'a Tensor, &'a Tensor); 2] {
        [(&self.geometry, &other.geometry), (&self.appearance, &other.appearance)]
    }
}

/// Encoder with its learned slots, streams and mixers.
#[derive(Debug)]
pub struct Encoder {
    auxiliaries: Tensor,
    global: Tensor,
    registers: Tensor,
    memory_registers: Tensor,
    geometry_start: StreamStart,
    geometry_rounds: Vec<StreamRound>,
    appearance: Option<Appearance>,
    latents: i64,
    /// Precision of the products of the rounds.
    pub(super) precision: Precision,
}

/// Appearance stream and mixers, which the dual-stream encoder has in addition to the geometry stream.
#[derive(Debug)]
struct Appearance {
    start: StreamStart,
    rounds: Vec<StreamRound>,
    mixers: Vec<Mixer>,
}

impl Encoder {
    /// Builds the encoder under `vs`, the encoder's own path.
    pub fn new(vs: &nn::Path, config: &ModelConfig) -> Self {
        let d = config.width;
        let tokens =
            |name: &str, count: i64, width: i64| vs.var(name, &[1, count, width], randn(ENCODER_STD));
        let rounds = |name: &str| {
            (0..config.rounds).map(|i| StreamRound::new(&(vs / name / i), config)).collect::<Vec<_>>()
        };
        Encoder {
            auxiliaries: tokens("aux_query_tokens", AUXILIARIES, d),
            global: tokens("scale_emb", 1, d),
            registers: tokens("slot_regs", REGISTERS, d),
            memory_registers: tokens("mem_regs", MEMORY_REGISTERS, config.token_width()),
            geometry_start: StreamStart::new(vs / "slot_to_geo", d),
            geometry_rounds: rounds("geo_rounds"),
            appearance: match config.streams {
                Streams::Single => None,
                Streams::Dual => Some(Appearance {
                    start: StreamStart::new(vs / "slot_to_tex", d),
                    rounds: rounds("tex_rounds"),
                    mixers: (0..config.rounds).map(|i| Mixer::new(&(vs / "pair_adapters" / i), d)).collect(),
                }),
            },
            latents: config.latents,
            precision: Precision::default(),
        }
    }

    /// Returns the layers that compute in the configurable precision.
    pub(super) fn linear_layers(&self) -> impl Iterator<Item = &nn::Linear> {
        let branch = self.appearance.iter();
        let rounds = self.geometry_rounds.iter().chain(branch.clone().flat_map(|branch| &branch.rounds));
        let mixers = branch.flat_map(|branch| &branch.mixers);
        rounds.flat_map(StreamRound::linear_layers).chain(mixers.flat_map(Mixer::linear_layers))
    }

    /// Calls [`StreamRound::fold_weights`] for every round of every stream.
    pub(super) fn fold_weights(&mut self) {
        let appearance = self.appearance.iter_mut().flat_map(|branch| &mut branch.rounds);
        let rounds = self.geometry_rounds.iter_mut().chain(appearance);
        rounds.for_each(|round| round.fold_weights(self.precision));
    }

    /// Returns `true` if gradients will flow back to the encoder's weights from what is computed now.
    pub(super) fn tracks_grad(&self) -> bool {
        tracks_grad(&self.memory_registers)
    }

    /// Computes the memory that all rounds read: learned tokens, then image tokens, `tokens` [B, V·P, token width].
    pub fn memory(&self, tokens: &Tensor) -> Memory {
        let registers = self.memory_registers.expand([tokens.size()[0], -1, -1], false);
        Memory::new(&Tensor::cat(&[&registers, tokens], 1))
    }

    /// Computes the memory without gradients from `views` views, one after the other, with [`Memory::from_views`].
    pub fn memory_of_views(&self, views: i64, view: impl Fn(i64) -> Tensor) -> Memory {
        Memory::from_views(&self.memory_registers, views, view, self.precision)
    }

    /// Encodes `scene_tokens` [M, d] with `memory`, the result of [`Encoder::memory`]. Calls `after_layers` each time that some of the
    /// weights have been used.
    pub fn forward(&self, scene_tokens: &Tensor, memory: &Memory, after_layers: &dyn Fn()) -> EncodedTokens {
        let mut slots = self.start(scene_tokens, memory.common.size()[0]);
        after_layers();
        for round in 0..self.rounds() {
            slots = self.round(round, &slots, memory, after_layers);
        }
        self.decoded(&slots)
    }

    /// Computes every stream's projection of the slots, for `batch` scenes.
    pub(super) fn start(&self, scene_tokens: &Tensor, batch: i64) -> Slots {
        let slots = [&self.auxiliaries, &scene_tokens.unsqueeze(0), &self.global, &self.registers];
        let slots = Tensor::cat(&slots, 1).expand([batch, -1, -1], false); // [B, 4 + M + 1 + 4, d]
        Slots {
            geometry: self.geometry_start.forward(&slots),
            appearance: self.appearance.as_ref().map(|branch| branch.start.forward(&slots)),
        }
    }

    /// Runs one round: each stream by itself, then the mixer. Calls `after_layers` each time that some of the weights have been used.
    pub(super) fn round(
        &self,
        round: usize,
        slots: &Slots,
        memory: &Memory,
        after_layers: &dyn Fn(),
    ) -> Slots {
        let precision = self.precision;
        let geometry = self.geometry_rounds[round].forward(&slots.geometry, memory, precision, after_layers);
        match (&self.appearance, &slots.appearance) {
            (Some(branch), Some(appearance)) => {
                let appearance = branch.rounds[round].forward(appearance, memory, precision, after_layers);
                let mixer = &branch.mixers[round];
                let (geometry, appearance) = mixer.forward(&geometry, &appearance, precision);
                after_layers();
                Slots { geometry, appearance: Some(appearance) }
            }
            _ => Slots { geometry, appearance: None },
        }
    }

    /// Returns the scene tokens among the slots.
    pub(super) fn decoded(&self, slots: &Slots) -> EncodedTokens {
        let decoded = |slots: &Tensor| slots.narrow(1, AUXILIARIES, self.latents);
        EncodedTokens {
            geometry: decoded(&slots.geometry),
            appearance: decoded(slots.appearance.as_ref().unwrap_or(&slots.geometry)),
        }
    }

    pub(super) fn rounds(&self) -> usize {
        self.geometry_rounds.len()
    }
}

/// State between rounds: both streams, or the only one, [B, 4 + M + 1 + 4, d] each.
#[derive(Debug)]
pub(super) struct Slots {
    geometry: Tensor,
    appearance: Option<Tensor>,
}

impl Slots {
    /// Applies `f` to every stream.
    pub fn map(&self, f: impl Fn(&Tensor) -> Tensor) -> Self {
        Slots { geometry: f(&self.geometry), appearance: self.appearance.as_ref().map(f) }
    }

    /// Pairs every stream with the corresponding one of `other`.
    pub fn zip_tensors<'a>(&'a self, other: &'a Slots) -> Vec<(&'a Tensor, &'a Tensor)> {
        let appearance = self.appearance.as_ref().zip(other.appearance.as_ref());
        std::iter::once((&self.geometry, &other.geometry)).chain(appearance).collect()
    }
}

/// Linear(LayerNorm(slots)): a stream's projection of the shared slots.
#[derive(Debug)]
struct StreamStart {
    norm: nn::LayerNorm,
    project: nn::Linear,
}

impl StreamStart {
    fn new(vs: nn::Path, d: i64) -> Self {
        StreamStart { norm: layer_norm(&vs / "0", d), project: linear(&vs / "1", d, d, ENCODER_STD) }
    }

    fn forward(&self, slots: &Tensor) -> Tensor {
        let normed = normalize(&self.norm, slots);
        trace_span!("queries and outputs").in_scope(|| Precision::F32.linear(&self.project, &normed))
    }
}
