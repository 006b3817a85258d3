//! The encoder: a fixed set of scene tokens reads every view, in two streams (SPEC section 4).

use super::config::{ModelConfig, Streams};
use super::layers::{ENCODER_STD, layer_norm, linear, randn};
use super::mixer::Mixer;
use super::stream::StreamRound;
use tch::{Tensor, nn, nn::Module};

/// Query tokens before the scene tokens; not decoded.
const AUXILIARIES: i64 = 4;
/// Tokens after the global token that only take part in self-attention.
pub(super) const REGISTERS: i64 = 4;
/// Learned tokens at the head of the memory.
const MEMORY_REGISTERS: i64 = 4;

/// Scene tokens that have seen every view, [B, M, d] each. With a single stream both are the same tensor.
#[derive(Debug)]
pub struct Encoded {
    /// For positions, scales, rotations, opacities and the gate.
    pub geometry: Tensor,
    /// For colour.
    pub appearance: Tensor,
}

/// Slots, streams and mixers.
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
}

/// What the dual-branch encoder has beyond a single stream.
#[derive(Debug)]
struct Appearance {
    start: StreamStart,
    rounds: Vec<StreamRound>,
    mixers: Vec<Mixer>,
}

impl Encoder {
    /// `vs` is the encoder's own path.
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
        }
    }

    /// `scene_tokens` [M, d], `tokens` [B, V·P, token width].
    pub fn forward(&self, scene_tokens: &Tensor, tokens: &Tensor) -> Encoded {
        let batch = tokens.size()[0];
        let expand = |t: &Tensor| t.expand([batch, -1, -1], false);
        let slots = [&self.auxiliaries, &scene_tokens.unsqueeze(0), &self.global, &self.registers];
        let slots = expand(&Tensor::cat(&slots, 1)); // [B, 4 + M + 1 + 4, d]
        let memory = Tensor::cat(&[expand(&self.memory_registers), tokens.shallow_clone()], 1);

        let decoded = |slots: &Tensor| slots.narrow(1, AUXILIARIES, self.latents);
        let mut geometry = self.geometry_start.forward(&slots);
        match &self.appearance {
            None => {
                for round in &self.geometry_rounds {
                    geometry = round.forward(&geometry, &memory);
                }
                Encoded { geometry: decoded(&geometry), appearance: decoded(&geometry) }
            }
            Some(branch) => {
                let mut appearance = branch.start.forward(&slots);
                for ((round, appearance_round), mixer) in
                    self.geometry_rounds.iter().zip(&branch.rounds).zip(&branch.mixers)
                {
                    geometry = round.forward(&geometry, &memory);
                    appearance = appearance_round.forward(&appearance, &memory);
                    (geometry, appearance) = mixer.forward(&geometry, &appearance);
                }
                Encoded { geometry: decoded(&geometry), appearance: decoded(&appearance) }
            }
        }
    }
}

/// Linear(LayerNorm(slots)): a stream's own view of the shared slots.
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
        self.project.forward(&self.norm.forward(slots))
    }
}
