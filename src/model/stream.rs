//! One stream's part of an encoder round: cross-attention to the images, an MLP, and self-attention among the slots (spec 4.2).

use super::attention::attention;
use super::config::ModelConfig;
use super::flops::record_flops;
use super::layers::{ENCODER_STD, LayerScale, Mlp, layer_norm, linear, normalize};
use super::memory::Memory;
use super::precision::Precision;
use tch::{Device, Tensor, nn};
use tracing::trace_span;

/// Number of registers, the last of the slots. They skip cross-attention and the first MLP.
pub(super) const REGISTERS: i64 = 4;
const MLP_RATIO: i64 = 4;
const CROSS_LAYER_SCALE: f64 = 1e-3;
const SELF_LAYER_SCALE: f64 = 1e-2;
/// Number of groups of heads that attend to the memory one after the other on a CPU without gradients.
const HEAD_GROUPS: i64 = 2;

/// One round of a stream: cross-attention from slots to memory, an MLP, and self-attention blocks over the slots.
#[derive(Debug)]
pub(crate) struct StreamRound {
    slots_norm: nn::LayerNorm,
    memory_norm: nn::LayerNorm,
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

/// Precomputed weights with which a round reads the memory.
#[derive(Debug)]
struct FoldedWeights {
    /// Layer that computes keys and values, concatenated, without the part that is common to all tokens.
    keys_and_values: nn::Linear,
    /// Layer that computes the part that is common to all values, in float32.
    common_value: nn::Linear,
}

impl StreamRound {
    pub fn new(vs: &nn::Path, config: &ModelConfig) -> Self {
        let (d, memory) = (config.width, config.token_width());
        StreamRound {
            slots_norm: layer_norm(vs / "slots_ln", d),
            memory_norm: layer_norm(vs / "mem_ln", memory),
            query: linear(vs / "lat_q", d, d, ENCODER_STD),
            key: linear(vs / "mem_k", memory, d, ENCODER_STD),
            value: linear(vs / "mem_v", memory, d, ENCODER_STD),
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

    /// Precomputes the weights with which every pass reads the memory, for products in `precision`.
    pub fn fold_weights(&mut self, precision: Precision) {
        let nn::Linear { ws, bs } = self.keys_and_values(0, self.query.ws.size()[0]);
        let keys_and_values = nn::Linear { ws: precision.operand(&ws), bs };
        self.folded = Some(FoldedWeights { keys_and_values, common_value: self.common_value() });
    }

    /// Returns the layers that compute in the configurable precision.
    pub fn linear_layers(&self) -> impl Iterator<Item = &nn::Linear> {
        let own =
            [&self.query, &self.key, &self.value, &self.output].into_iter().chain(self.mlp.linear_layers());
        own.chain(self.blocks.iter().flat_map(SelfAttentionBlock::linear_layers))
    }

    /// Updates the slots. `slots` is [B, S, d] with the registers last; the result is [B, S, d]. Calls `after_layers` each time that some
    /// of the weights have been used.
    pub fn forward(
        &self,
        slots: &Tensor,
        memory: &Memory,
        precision: Precision,
        after_layers: &dyn Fn(),
    ) -> Tensor {
        // Registers change only in self-attention and in the mixer.
        let reading = slots.size()[1] - REGISTERS;
        let registers = slots.narrow(1, reading, REGISTERS);
        let slots = slots.narrow(1, 0, reading);

        let normed = normalize(&self.slots_norm, &slots);
        let query = trace_span!("queries and outputs").in_scope(|| precision.linear(&self.query, &normed));
        after_layers();
        let attn_out = self.cross_attention(&query, memory, precision, after_layers);
        let attn_out =
            trace_span!("queries and outputs").in_scope(|| precision.linear(&self.output, &attn_out));
        after_layers();
        let slots = self.attention_scale.add(&slots, &attn_out);
        let mlp_out = self.mlp.forward(&normalize(&self.mlp_norm, &slots), precision);
        after_layers();
        let slots = self.mlp_scale.add(&slots, &mlp_out);

        let slots = Tensor::cat(&[slots, registers], 1);
        self.blocks.iter().fold(slots, |slots, block| block.forward(&slots, precision, after_layers))
    }

    /// Computes cross-attention of `query` [B, n, d] to the memory. On a CPU without gradients, groups of heads are processed one after the
    /// other, because the keys and values of all heads are larger than the memory they are computed from.
    ///
    /// The memory is γ ⊙ (y + c) + β, where y is what tokens differ by and c what they have in common (spec 4.2). Softmax is invariant to a
    /// constant added to all keys, and attention weights sum to 1. So keys are W_k (γ ⊙ y) and values W_v (γ ⊙ y), and the contribution of
    /// c, β and the values' bias is added after attention. The keys' own bias has no effect.
    fn cross_attention(
        &self,
        query: &Tensor,
        memory: &Memory,
        precision: Precision,
        after_layers: &dyn Fn(),
    ) -> Tensor {
        let is_for_all =
            query.requires_grad() || query.device() != Device::Cpu || self.heads % HEAD_GROUPS != 0;
        let groups = if is_for_all { 1 } else { HEAD_GROUPS };
        let width = query.size()[2] / groups;
        let attn_out: Vec<Tensor> = (0..groups)
            .map(|group| {
                let query = query.narrow(-1, group * width, width);
                let read = trace_span!("keys and values").in_scope(|| match &self.folded {
                    Some(folded) if groups == 1 => precision.linear(&folded.keys_and_values, &memory.tokens),
                    _ => precision.linear(&self.keys_and_values(group * width, width), &memory.tokens),
                });
                after_layers();
                let read = read.chunk(2, -1);
                trace_span!("cross-attention")
                    .in_scope(|| attention(&query, &read[0], &read[1], self.heads / groups))
            })
            .collect();
        let by_all = trace_span!("keys and values").in_scope(|| match &self.folded {
            Some(folded) => Precision::F32.linear(&folded.common_value, &memory.common),
            None => self.value_offset(memory),
        });
        after_layers();
        let attn_out = match &attn_out[..] {
            [attn_out] => attn_out.shallow_clone(),
            several => Tensor::cat(several, -1),
        };
        trace_span!("residual sums").in_scope(|| {
            let out = &attn_out + &by_all;
            record_flops(0, 0, &[&attn_out, &out]);
            out
        })
    }

    /// Returns the layer for keys and values, concatenated, without their common part, restricted to `width` channels from `first` on of
    /// each: W (γ ⊙ y) = (W diag γ) y. All rounds thus share the part of the norm without γ and β, and read it with one product.
    fn keys_and_values(&self, first: i64, width: i64) -> nn::Linear {
        let [gamma, _] = self.memory_affine();
        let rows = [&self.key.ws, &self.value.ws].map(|ws| ws.narrow(0, first, width));
        let weights = Tensor::cat(&rows, 0).to_kind(gamma.kind()); // [2 width, token width]
        nn::Linear { ws: weights * gamma, bs: None }
    }

    /// Computes the common part of all values, W_v (γ ⊙ c + β) + b_v, [B, 1, d] in float32.
    fn value_offset(&self, memory: &Memory) -> Tensor {
        let [gamma, beta] = self.memory_affine();
        let exact = |t: &Tensor| t.to_kind(gamma.kind());
        let value = nn::Linear { ws: exact(&self.value.ws), bs: self.value.bs.as_ref().map(exact) };
        let of_values = Precision::F32.linear(&value, &(&memory.common * gamma + beta));
        // The key bias has no effect. This gives it a zero gradient rather than none, as every learned parameter must have one.
        of_values + self.key.bs.as_ref().map(exact).expect("a bias") * 0.
    }

    /// Returns [`StreamRound::value_offset`] as a linear layer of c: (W_v diag γ) c + (W_v β + b_v).
    fn common_value(&self) -> nn::Linear {
        let [gamma, beta] = self.memory_affine();
        let exact = |t: &Tensor| t.to_kind(gamma.kind());
        let [value, bias] = [&self.value.ws, self.value.bs.as_ref().expect("a bias")].map(exact);
        nn::Linear { bs: Some(value.mv(beta) + bias), ws: value * gamma }
    }

    /// Returns γ and β of the memory's norm, [token width] each.
    fn memory_affine(&self) -> [&Tensor; 2] {
        [&self.memory_norm.ws, &self.memory_norm.bs].map(|t| t.as_ref().expect("an affine norm"))
    }
}

/// Pre-norm transformer block.
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

    /// Applies the block to `xs` [B, S, d]; the result has the same shape. Calls `after_layers` as [`StreamRound::forward`] does.
    pub fn forward(&self, xs: &Tensor, precision: Precision, after_layers: &dyn Fn()) -> Tensor {
        let normed = normalize(&self.attention_norm, xs);
        let qkv =
            trace_span!("queries and outputs").in_scope(|| precision.linear(&self.qkv, &normed)).chunk(3, -1);
        after_layers();
        let mixed =
            trace_span!("self-attention").in_scope(|| attention(&qkv[0], &qkv[1], &qkv[2], self.heads));
        let mixed = trace_span!("queries and outputs").in_scope(|| precision.linear(&self.project, &mixed));
        after_layers();
        let xs = self.attention_scale.add(xs, &mixed);
        let mlp_out = self.mlp.forward(&normalize(&self.mlp_norm, &xs), precision);
        after_layers();
        self.mlp_scale.add(&xs, &mlp_out)
    }
}

#[cfg(test)]
mod tests {
    use super::super::memory::tests::{alike, uneven};
    use super::*;
    use tch::no_grad;

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
        let (query, memory) = (uneven(0.9, &[2, 9, 32]), Memory::new(&alike(30)));
        for (precision, most) in [(Precision::F32, 1e-5), (Precision::Bf16, 1e-2)] {
            let (query, memory) = (query.to_kind(precision.kind()), memory.to_kind(precision.kind()));
            round.folded = None;
            let expected = no_grad(|| round.cross_attention(&query, &memory, precision, &|| ()));
            no_grad(|| round.fold_weights(precision));
            let found = no_grad(|| round.cross_attention(&query, &memory, precision, &|| ()));
            let error = ((&found - &expected).norm() / expected.norm()).double_value(&[]);
            assert!(error < most, "{precision}: {error:.1e}");
        }
    }

    #[test]
    fn tokens_that_are_alike_are_told_apart_in_bf16() {
        let config = ModelConfig { width: 32, heads: 2, rgb_width: 16, ray_width: 8, ..Default::default() };
        let vs = nn::VarStore::new(Device::Cpu);
        let round = StreamRound::new(&vs.root(), &config);
        // Scores that differ, and nonzero biases, as after training.
        for (name, mut value) in vs.variables() {
            let trained = uneven(1.3, &value.size());
            if ["mem_k", "mem_v"].iter().any(|layer| name.starts_with(layer)) || name == "mem_ln.bias" {
                no_grad(|| value.copy_(&trained));
            }
        }
        let query = uneven(0.9, &[2, 9, 32]) * 3.;
        let memory = Memory::new(&alike(300));
        let whole = Memory { tokens: &memory.tokens + &memory.common, common: memory.common.zeros_like() };
        let attn_out = |memory: &Memory, precision: Precision| {
            let query = query.to_kind(precision.kind());
            no_grad(|| round.cross_attention(&query, memory, precision, &|| ()))
        };
        let exact = attn_out(&memory, Precision::F32);
        let size = (&exact - exact.mean_dim(1, true, None)).norm(); // norm of the differences among queries
        let error = |found: Tensor| ((found - &exact).norm() / &size).double_value(&[]);
        let same = error(attn_out(&whole, Precision::F32));
        // Scores of tokens with their common part lose digits in float32, too.
        assert!(same < 1e-3, "nothing depends on what is called common, but {same:.1e}");
        let [near, far] = [&memory, &whole].map(|memory| error(attn_out(memory, Precision::Bf16)));
        assert!(near < 3e-2 && far > 20. * near, "{near:.1e}, and {far:.1e} of tokens as they are");
    }
}
