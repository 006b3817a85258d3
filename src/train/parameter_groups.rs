//! Which of a network's weights decay.

use crate::config::TrainConfig;
use crate::optim::ParameterGroup;
use tch::{Tensor, nn};

/// The trained variables of `vs`: weights of two or more dimensions decay; biases, norms, LayerScale and learned tokens don't
/// (spec 8.5).
pub fn parameter_groups(vs: &nn::VarStore, config: &TrainConfig) -> Vec<ParameterGroup> {
    let trained = vs.variables().into_iter().filter(|(_, value)| value.requires_grad());
    let decays = |(name, value): &(String, Tensor)| name.ends_with(".weight") && value.dim() >= 2;
    let (decaying, others): (Vec<_>, Vec<_>) = trained.partition(decays);
    let group = |parameters, weight_decay| ParameterGroup {
        parameters,
        learning_rate: config.learning_rate,
        weight_decay,
    };
    vec![group(decaying, config.weight_decay), group(others, 0.)]
}

/// The trained variables of `vs` in the order in which the backward pass gives their gradients, about: of the decoder, of the encoder's
/// rounds from the last to the first, and of what comes before them. By the names alone, so it is the same in every process.
pub fn in_backward_order(vs: &nn::VarStore) -> Vec<(String, Tensor)> {
    let mut trained: Vec<_> = vs.variables().into_iter().filter(|(_, value)| value.requires_grad()).collect();
    trained.sort_by_cached_key(|(name, _)| (turn(name), name.clone()));
    trained
}

/// The lower, the earlier.
fn turn(name: &str) -> i64 {
    let mut words = name.split('.');
    match (words.next(), words.next(), words.next().and_then(|word| word.parse::<i64>().ok())) {
        (Some("gaussian_decoder"), ..) => i64::MIN,
        (Some("slot_encoder"), Some("geo_rounds" | "tex_rounds" | "pair_adapters"), Some(round)) => -round,
        (Some("slot_encoder"), ..) => 1,
        _ => 2,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::{Device, nn::Init};

    #[test]
    fn weights_decay_and_nothing_else_does() {
        let vs = nn::VarStore::new(Device::Cpu);
        let layer = vs.root() / "layer";
        let _variables = [
            layer.var("weight", &[2, 3], Init::Const(0.)),
            layer.var("bias", &[2], Init::Const(0.)),
            (vs.root() / "norm").var("weight", &[3], Init::Const(1.)),
            vs.root().var("tokens", &[1, 4, 3], Init::Const(0.)),
            vs.root().zeros_no_train("constant", &[2, 2]),
        ];
        let groups = parameter_groups(&vs, &TrainConfig { weight_decay: 0.1, ..Default::default() });
        let names = |group: &ParameterGroup| {
            let mut names: Vec<String> = group.parameters.iter().map(|(name, _)| name.clone()).collect();
            names.sort();
            names
        };
        assert_eq!((names(&groups[0]), groups[0].weight_decay), (vec!["layer.weight".into()], 0.1));
        let others: Vec<String> = ["layer.bias", "norm.weight", "tokens"].map(String::from).into();
        assert_eq!((names(&groups[1]), groups[1].weight_decay), (others, 0.));
    }
}
