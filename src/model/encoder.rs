//! The encoder (spec 4): a fixed set of scene tokens attends to the image tokens of every view, in two streams that a mixer joins after
//! every round.

use super::config::{ModelConfig, Streams};
use super::layers::{ENCODER_STD, LayerScale, Mlp, attention, layer_norm, linear, normalize, project, randn};
use super::precision::{Precision, record_op};
use super::tokens::ImageTokens;
use super::{backward_from_grads, leaf, tracks_grad};
use tch::{Device, Tensor, nn, no_grad};
use tracing::trace_span;

/// Number of auxiliary query tokens before the scene tokens; they are not decoded.
const AUXILIARIES: i64 = 4;
/// Number of learned tokens before the image tokens.
const TOKEN_REGISTERS: i64 = 4;
/// Number of registers, the last of the slots. They skip cross-attention and the first MLP.
pub(super) const REGISTERS: i64 = 4;
const MLP_RATIO: i64 = 4;
const CROSS_LAYER_SCALE: f64 = 1e-3;
const SELF_LAYER_SCALE: f64 = 1e-2;
/// Number of groups of heads that attend to the image tokens one after the other on a CPU without gradients.
const HEAD_GROUPS: i64 = 2;
const MIXER_LAYER_SCALE: f64 = 1e-3;

/// Pre-norm transformer block among the slots.
#[derive(Debug)]
pub(crate) struct SelfAttentionBlock {
    attention_norm: nn::LayerNorm,
    qkv: nn::Linear,
    project: nn::Linear,
    attention_scale: LayerScale,
    mlp_norm: nn::LayerNorm,
    mlp: Mlp,
    mlp_scale: LayerScale,
    heads: i64,
}

impl SelfAttentionBlock {
    pub fn new(vs: &nn::Path, d: i64, heads: i64) -> Self {
        SelfAttentionBlock {
            attention_norm: layer_norm(vs / "norm1", d),
            qkv: linear(vs / "attn" / "qkv", d, 3 * d, ENCODER_STD),
            project: linear(vs / "attn" / "proj", d, d, ENCODER_STD),
            attention_scale: LayerScale::new(vs / "ls1", d, SELF_LAYER_SCALE),
            mlp_norm: layer_norm(vs / "norm2", d),
            mlp: Mlp::new(vs / "mlp", d, MLP_RATIO * d, d, ["fc1", "fc2"]),
            mlp_scale: LayerScale::new(vs / "ls2", d, SELF_LAYER_SCALE),
            heads,
        }
    }

    fn linear_layers(&self) -> impl Iterator<Item = &nn::Linear> {
        [&self.qkv, &self.project].into_iter().chain(self.mlp.linear_layers())
    }

    /// Applies the block to `xs` [B, S, d]; the result has the same shape.
    pub fn forward(&self, xs: &Tensor, precision: Precision) -> Tensor {
        let qkv = project(&self.qkv, &normalize(&self.attention_norm, xs), precision).chunk(3, -1);
        let attn_out =
            trace_span!("self-attention").in_scope(|| attention(&qkv[0], &qkv[1], &qkv[2], self.heads));
        let xs = self.attention_scale.add(xs, &project(&self.project, &attn_out, precision));
        let mlp_out = self.mlp.forward(&normalize(&self.mlp_norm, &xs), precision);
        self.mlp_scale.add(&xs, &mlp_out)
    }
}

/// One round of a stream (spec 4.2): cross-attention from the slots to the image tokens, an MLP, and self-attention among the slots.
#[derive(Debug)]
pub(crate) struct StreamRound {
    slots_norm: nn::LayerNorm,
    token_norm: nn::LayerNorm,
    query: nn::Linear,
    key: nn::Linear,
    value: nn::Linear,
    output: nn::Linear,
    attention_scale: LayerScale,
    mlp_norm: nn::LayerNorm,
    mlp: Mlp,
    mlp_scale: LayerScale,
    blocks: Vec<SelfAttentionBlock>,
    heads: i64,
    folded: Option<FoldedWeights>,
}

/// Precomputed weights with which a round reads the image tokens.
#[derive(Debug)]
struct FoldedWeights {
    /// Layer that computes keys and values, concatenated, of centered tokens.
    keys_and_values: nn::Linear,
    /// Layer that computes the value of the mean token, in float32.
    mean_value: nn::Linear,
}

impl StreamRound {
    pub fn new(vs: &nn::Path, config: &ModelConfig) -> Self {
        let (d, token_width) = (config.width, config.token_width());
        StreamRound {
            slots_norm: layer_norm(vs / "slots_ln", d),
            token_norm: layer_norm(vs / "mem_ln", token_width),
            query: linear(vs / "lat_q", d, d, ENCODER_STD),
            key: linear(vs / "mem_k", token_width, d, ENCODER_STD),
            value: linear(vs / "mem_v", token_width, d, ENCODER_STD),
            output: linear(vs / "out_proj", d, d, ENCODER_STD),
            attention_scale: LayerScale::new(vs / "attn_ls", d, CROSS_LAYER_SCALE),
            mlp_norm: layer_norm(vs / "post_ln", d),
            mlp: Mlp::new(vs / "mlp", d, MLP_RATIO * d, d, ["0", "2"]),
            mlp_scale: LayerScale::new(vs / "mlp_ls", d, CROSS_LAYER_SCALE),
            blocks: (0..config.self_attention_blocks)
                .map(|i| SelfAttentionBlock::new(&(vs / "tower" / i), d, config.heads))
                .collect(),
            heads: config.heads,
            folded: None,
        }
    }

    /// Precomputes the weights with which every pass reads the image tokens, for products in `precision`.
    pub fn fold_weights(&mut self, precision: Precision) {
        let nn::Linear { ws, bs } = self.keys_and_values(0, self.query.ws.size()[0]);
        let keys_and_values = nn::Linear { ws: precision.operand(&ws), bs };
        self.folded = Some(FoldedWeights { keys_and_values, mean_value: self.folded_mean_value() });
    }

    /// Returns the layers that compute in the configurable precision.
    pub fn linear_layers(&self) -> impl Iterator<Item = &nn::Linear> {
        let own =
            [&self.query, &self.key, &self.value, &self.output].into_iter().chain(self.mlp.linear_layers());
        own.chain(self.blocks.iter().flat_map(SelfAttentionBlock::linear_layers))
    }

    /// Updates the slots. `slots` is [B, S, d] with the registers last; the result is [B, S, d].
    pub fn forward(&self, slots: &Tensor, tokens: &ImageTokens, precision: Precision) -> Tensor {
        // Registers change only in self-attention and in the mixer.
        let reading = slots.size()[1] - REGISTERS;
        let registers = slots.narrow(1, reading, REGISTERS);
        let slots = slots.narrow(1, 0, reading);

        let query = project(&self.query, &normalize(&self.slots_norm, &slots), precision);
        let attn_out = project(&self.output, &self.cross_attention(&query, tokens, precision), precision);
        let slots = self.attention_scale.add(&slots, &attn_out);
        let mlp_out = self.mlp.forward(&normalize(&self.mlp_norm, &slots), precision);
        let slots = self.mlp_scale.add(&slots, &mlp_out);

        let slots = Tensor::cat(&[slots, registers], 1);
        self.blocks.iter().fold(slots, |slots, block| block.forward(&slots, precision))
    }

    /// Computes cross-attention of `query` [B, n, d] to the image tokens. On a CPU without gradients, groups of heads are processed one
    /// after the other, because the keys and values of all heads are larger than the tokens they are computed from.
    ///
    /// The normalized tokens are γ ⊙ (y + c) + β, where c is the mean token and y the difference from it (spec 4.2). Softmax is invariant to
    /// a constant added to all keys, and attention weights sum to 1. So keys are W_k (γ ⊙ y) and values W_v (γ ⊙ y), and the contribution of
    /// c, β and the values' bias is added after attention. The keys' own bias has no effect.
    fn cross_attention(&self, query: &Tensor, tokens: &ImageTokens, precision: Precision) -> Tensor {
        let is_at_once =
            query.requires_grad() || query.device() != Device::Cpu || self.heads % HEAD_GROUPS != 0;
        let groups = if is_at_once { 1 } else { HEAD_GROUPS };
        let width = query.size()[2] / groups;
        let attn_out: Vec<Tensor> = (0..groups)
            .map(|group| {
                let query = query.narrow(-1, group * width, width);
                let read = trace_span!("keys and values").in_scope(|| match &self.folded {
                    Some(folded) if groups == 1 => {
                        precision.linear(&folded.keys_and_values, &tokens.centered)
                    }
                    _ => precision.linear(&self.keys_and_values(group * width, width), &tokens.centered),
                });
                let read = read.chunk(2, -1);
                trace_span!("cross-attention")
                    .in_scope(|| attention(&query, &read[0], &read[1], self.heads / groups))
            })
            .collect();
        let mean_value = trace_span!("keys and values").in_scope(|| match &self.folded {
            Some(folded) => Precision::F32.linear(&folded.mean_value, &tokens.mean),
            None => self.mean_value(&tokens.mean),
        });
        let attn_out = match &attn_out[..] {
            [attn_out] => attn_out.shallow_clone(),
            several => Tensor::cat(several, -1),
        };
        record_op(trace_span!("residual sums"), &[&attn_out], || &attn_out + &mean_value)
    }

    /// Returns the layer that computes keys and values, concatenated, of centered tokens, restricted to `width` channels from `first` on of
    /// each: W (γ ⊙ y) = (W diag γ) y. All rounds thus share the part of the norm without γ and β, and read it with one product.
    fn keys_and_values(&self, first: i64, width: i64) -> nn::Linear {
        let [gamma, _] = self.token_affine();
        let rows = [&self.key.ws, &self.value.ws].map(|ws| ws.narrow(0, first, width));
        let weights = Tensor::cat(&rows, 0).to_kind(gamma.kind()); // [2 width, token width]
        nn::Linear { ws: weights * gamma, bs: None }
    }

    /// Computes the value of the mean token c, W_v (γ ⊙ c + β) + b_v, [B, 1, d] in float32.
    fn mean_value(&self, mean: &Tensor) -> Tensor {
        let [gamma, beta] = self.token_affine();
        let exact = |t: &Tensor| t.to_kind(gamma.kind());
        let value = nn::Linear { ws: exact(&self.value.ws), bs: self.value.bs.as_ref().map(exact) };
        let mean_value = Precision::F32.linear(&value, &(mean * gamma + beta));
        // The key bias has no effect. This gives it a zero gradient rather than none, as every learned parameter must have one.
        mean_value + self.key.bs.as_ref().map(exact).expect("a bias") * 0.
    }

    /// Returns [`StreamRound::mean_value`] as a linear layer of c: (W_v diag γ) c + (W_v β + b_v).
    fn folded_mean_value(&self) -> nn::Linear {
        let [gamma, beta] = self.token_affine();
        let exact = |t: &Tensor| t.to_kind(gamma.kind());
        let [value, bias] = [&self.value.ws, self.value.bs.as_ref().expect("a bias")].map(exact);
        nn::Linear { bs: Some(value.mv(beta) + bias), ws: value * gamma }
    }

    /// Returns γ and β of the image tokens' norm, [token width] each.
    fn token_affine(&self) -> [&Tensor; 2] {
        [&self.token_norm.ws, &self.token_norm.bs].map(|t| t.as_ref().expect("an affine norm"))
    }
}

/// Exchange of information between the two streams, once per round (spec 4.3): an MLP over the concatenated streams; each half of its output is added to one stream.
#[derive(Debug)]
pub(crate) struct Mixer {
    geometry_norm: nn::LayerNorm,
    appearance_norm: nn::LayerNorm,
    mlp: Mlp,
    geometry_scale: LayerScale,
    appearance_scale: LayerScale,
}

impl Mixer {
    pub fn new(vs: &nn::Path, d: i64) -> Self {
        Mixer {
            geometry_norm: layer_norm(vs / "ln_g", d),
            appearance_norm: layer_norm(vs / "ln_t", d),
            mlp: Mlp::new(vs / "mlp", 2 * d, d, 2 * d, ["0", "2"]),
            geometry_scale: LayerScale::new(vs / "ls_g", d, MIXER_LAYER_SCALE),
            appearance_scale: LayerScale::new(vs / "ls_t", d, MIXER_LAYER_SCALE),
        }
    }

    /// Returns the layers that compute in the configurable precision.
    pub fn linear_layers(&self) -> impl Iterator<Item = &nn::Linear> {
        self.mlp.linear_layers().into_iter()
    }

    /// Mixes the two streams, [B, S, d] each; the results have the same shape.
    pub fn forward(&self, geometry: &Tensor, appearance: &Tensor, precision: Precision) -> [Tensor; 2] {
        trace_span!("mixer").in_scope(|| {
            let both =
                [normalize(&self.geometry_norm, geometry), normalize(&self.appearance_norm, appearance)];
            let mixed = self.mlp.forward(&Tensor::cat(&both, -1), precision).chunk(2, -1);
            [self.geometry_scale.add(geometry, &mixed[0]), self.appearance_scale.add(appearance, &mixed[1])]
        })
    }
}

/// Scene tokens that have attended to every view, [B, M, d] each. With a single stream both fields are the same tensor.
#[derive(Debug)]
pub struct EncodedTokens {
    /// Tokens from which positions, scales, rotations, opacities and the gate are decoded.
    pub geometry: Tensor,
    /// Tokens from which colors are decoded.
    pub appearance: Tensor,
}

impl EncodedTokens {
    /// Applies `f` to both tensors.
    pub(crate) fn map(&self, f: impl Fn(&Tensor) -> Tensor) -> Self {
        EncodedTokens { geometry: f(&self.geometry), appearance: f(&self.appearance) }
    }

    /// Returns both tensors.
    pub(crate) fn tensors(&self) -> [&Tensor; 2] {
        [&self.geometry, &self.appearance]
    }
}

/// Stream of slots: its projection Linear(LayerNorm(slots)) of the shared slots, and its rounds.
#[derive(Debug)]
struct Stream {
    norm: nn::LayerNorm,
    project: nn::Linear,
    rounds: Vec<StreamRound>,
}

impl Stream {
    /// Builds the stream under `vs`, the encoder's path. `start` and `rounds` are the names of its parts.
    fn new(vs: &nn::Path, config: &ModelConfig, start: &str, rounds: &str) -> Self {
        let d = config.width;
        Stream {
            norm: layer_norm(vs / start / "0", d),
            project: linear(vs / start / "1", d, d, ENCODER_STD),
            rounds: (0..config.rounds).map(|i| StreamRound::new(&(vs / rounds / i), config)).collect(),
        }
    }

    fn start(&self, slots: &Tensor) -> Tensor {
        project(&self.project, &normalize(&self.norm, slots), Precision::F32)
    }
}

/// Encoder with its learned slots, streams and mixers.
#[derive(Debug)]
pub struct Encoder {
    auxiliaries: Tensor,
    global: Tensor,
    registers: Tensor,
    token_registers: Tensor,
    /// The geometry stream, then the appearance stream if there are two.
    streams: Vec<Stream>,
    /// One mixer per round if there are two streams.
    mixers: Vec<Mixer>,
    latents: i64,
    /// Precision of the products of the rounds.
    pub(super) precision: Precision,
}

impl Encoder {
    /// Builds the encoder under `vs`, the encoder's own path.
    pub fn new(vs: &nn::Path, config: &ModelConfig) -> Self {
        let d = config.width;
        let tokens =
            |name: &str, count: i64, width: i64| vs.var(name, &[1, count, width], randn(ENCODER_STD));
        let mut encoder = Encoder {
            auxiliaries: tokens("aux_query_tokens", AUXILIARIES, d),
            global: tokens("scale_emb", 1, d),
            registers: tokens("slot_regs", REGISTERS, d),
            token_registers: tokens("mem_regs", TOKEN_REGISTERS, config.token_width()),
            streams: vec![Stream::new(vs, config, "slot_to_geo", "geo_rounds")],
            mixers: vec![],
            latents: config.latents,
            precision: Precision::default(),
        };
        if config.streams == Streams::Dual {
            encoder.streams.push(Stream::new(vs, config, "slot_to_tex", "tex_rounds"));
            encoder.mixers = (0..config.rounds).map(|i| Mixer::new(&(vs / "pair_adapters" / i), d)).collect();
        }
        encoder
    }

    /// Returns the layers that compute in the configurable precision.
    pub(super) fn linear_layers(&self) -> impl Iterator<Item = &nn::Linear> {
        let rounds = self.streams.iter().flat_map(|stream| &stream.rounds);
        rounds.flat_map(StreamRound::linear_layers).chain(self.mixers.iter().flat_map(Mixer::linear_layers))
    }

    /// Calls [`StreamRound::fold_weights`] for every round of every stream.
    pub(super) fn fold_weights(&mut self) {
        let rounds = self.streams.iter_mut().flat_map(|stream| &mut stream.rounds);
        rounds.for_each(|round| round.fold_weights(self.precision));
    }

    /// Returns `true` if gradients will flow back to the encoder's weights from what is computed now.
    pub(super) fn tracks_grad(&self) -> bool {
        tracks_grad(&self.token_registers)
    }

    /// Builds the image tokens that all rounds read: learned tokens, then `tokens` [B, V·P, token width].
    pub fn image_tokens(&self, tokens: &Tensor) -> ImageTokens {
        let registers = self.token_registers.expand([tokens.size()[0], -1, -1], false);
        ImageTokens::new(&Tensor::cat(&[&registers, tokens], 1))
    }

    /// Builds the image tokens without gradients from `views` views, one after the other, with [`ImageTokens::from_views`].
    pub fn image_tokens_of_views(&self, views: i64, view: impl Fn(i64) -> Tensor) -> ImageTokens {
        ImageTokens::from_views(&self.token_registers, views, view, self.precision)
    }

    /// Encodes `scene_tokens` [M, d] with `tokens`, the result of [`Encoder::image_tokens`].
    pub fn forward(&self, scene_tokens: &Tensor, tokens: &ImageTokens) -> EncodedTokens {
        let slots = self.start(scene_tokens, tokens.mean.size()[0]);
        self.scene_tokens(&(0..self.rounds()).fold(slots, |slots, round| self.round(round, &slots, tokens)))
    }

    /// Computes every stream's projection of the slots, [B, 4 + M + 1 + 4, d] each, for B = `batch` scenes.
    fn start(&self, scene_tokens: &Tensor, batch: i64) -> Vec<Tensor> {
        let slots = [&self.auxiliaries, &scene_tokens.unsqueeze(0), &self.global, &self.registers];
        let slots = Tensor::cat(&slots, 1).expand([batch, -1, -1], false);
        self.streams.iter().map(|stream| stream.start(&slots)).collect()
    }

    /// Runs one round: each stream by itself, then the mixer.
    fn round(&self, round: usize, slots: &[Tensor], tokens: &ImageTokens) -> Vec<Tensor> {
        let streams = self.streams.iter().zip(slots);
        let slots: Vec<Tensor> = streams
            .map(|(stream, slots)| stream.rounds[round].forward(slots, tokens, self.precision))
            .collect();
        match &slots[..] {
            [geometry, appearance] => self.mixers[round].forward(geometry, appearance, self.precision).into(),
            _ => slots,
        }
    }

    /// Returns the scene tokens among the slots.
    fn scene_tokens(&self, slots: &[Tensor]) -> EncodedTokens {
        let narrow = |slots: &Tensor| slots.narrow(1, AUXILIARIES, self.latents);
        EncodedTokens { geometry: narrow(&slots[0]), appearance: narrow(&slots[slots.len() - 1]) }
    }

    fn rounds(&self) -> usize {
        self.streams[0].rounds.len()
    }
}

impl Encoder {
    /// Runs [`Encoder::forward`] with activation checkpointing: it stores only the input of every round, and the backward pass recomputes
    /// the round. Run the backward pass of the result first, then [`CheckpointedRounds::backward`]. `tokens` are detached: all rounds read
    /// them, so they accumulate the sum of their gradients.
    pub(super) fn forward_checkpointed<'a>(
        &'a self,
        scene_tokens: &Tensor,
        tokens: &'a ImageTokens,
    ) -> (EncodedTokens, CheckpointedRounds<'a>) {
        let leaves = |slots: &[Tensor]| slots.iter().map(leaf).collect::<Vec<_>>();
        let slots = self.start(scene_tokens, tokens.mean.size()[0]);
        let mut between = vec![leaves(&slots)];
        for round in 0..self.rounds() {
            between.push(leaves(&no_grad(|| self.round(round, &between[round], tokens))));
        }
        let encoded = self.scene_tokens(&between[self.rounds()]);
        (encoded, CheckpointedRounds { encoder: self, tokens, slots, between })
    }
}

/// State that the backward pass needs from the encoder's forward pass with activation checkpointing.
#[derive(Debug)]
pub(crate) struct CheckpointedRounds<'a> {
    encoder: &'a Encoder,
    tokens: &'a ImageTokens,
    /// Slots before the first round, attached to the graph of the scene tokens.
    slots: Vec<Tensor>,
    /// Detached slots before every round, and after the last one.
    between: Vec<Vec<Tensor>>,
}

impl CheckpointedRounds<'_> {
    /// Runs the backward pass from the last round to the first, then through the initial slots.
    pub fn backward(mut self) {
        for round in (0..self.encoder.rounds()).rev() {
            let after = self.between.pop().expect("one more than rounds");
            let again = self.encoder.round(round, &self.between[round], self.tokens);
            backward_from_grads(again.iter().zip(&after));
        }
        backward_from_grads(self.slots.iter().zip(&self.between[0]));
    }
}

#[cfg(test)]
mod tests {
    use super::super::tokens::tests::{alike, uneven};
    use super::*;

    #[test]
    fn folded_weights_read_the_same() {
        // With an odd number of heads a CPU processes all heads together, as a GPU does for any number.
        let config = ModelConfig { width: 32, heads: 1, rgb_width: 16, ray_width: 8, ..Default::default() };
        let vs = nn::VarStore::new(Device::Cpu);
        let mut round = StreamRound::new(&vs.root(), &config);
        for (name, mut value) in vs.variables() {
            let is_read_with = ["mem_k", "mem_v", "mem_ln"].iter().any(|layer| name.starts_with(layer));
            if is_read_with {
                no_grad(|| value.copy_(&uneven(1.3, &value.size())));
            }
        }
        let (query, tokens) = (uneven(0.9, &[2, 9, 32]), ImageTokens::new(&alike(30)));
        for (precision, most) in [(Precision::F32, 1e-5), (Precision::Bf16, 1e-2)] {
            let (query, tokens) = (query.to_kind(precision.kind()), tokens.to_kind(precision.kind()));
            round.folded = None;
            let expected = no_grad(|| round.cross_attention(&query, &tokens, precision));
            no_grad(|| round.fold_weights(precision));
            let found = no_grad(|| round.cross_attention(&query, &tokens, precision));
            let error = ((&found - &expected).norm() / expected.norm()).double_value(&[]);
            assert!(error < most, "{precision}: {error:.1e}");
        }
    }
}
