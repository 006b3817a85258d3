//! Attention (spec 4.2): by our own kernel where it is the fastest, by libtorch's elsewhere.

use globalsplat_csrc::attention as ours;
use tch::{Device, Kind, Tensor};

/// softmax(q kᵀ / √(d/h)) v over `heads` heads; q [B, n, d], k and v [B, m, d], result [B, n, d] of their kind.
pub(crate) fn attention(q: &Tensor, k: &Tensor, v: &Tensor, heads: i64) -> Tensor {
    let all = [q, k, v];
    let takes = |t: &&Tensor| t.device() == Device::Cpu && t.kind() == Kind::Float;
    if !all.iter().all(takes) || !ours::attention_takes(q.size()[2] / heads) {
        return by_libtorch(q, k, v, heads);
    }
    let [q, k, v] = all.map(|t| t.as_ptr() as usize);
    // SAFETY: the tensors outlive the call, which on success returns the address of a new one.
    let out = unsafe { ours::attention(q, k, v, heads) }.unwrap_or_else(|error| panic!("{error}"));
    unsafe { Tensor::from_ptr(out as *mut torch_sys::C_tensor) }
}

/// The same on any device, in any kind and width.
pub(crate) fn by_libtorch(q: &Tensor, k: &Tensor, v: &Tensor, heads: i64) -> Tensor {
    let split = |t: &Tensor| {
        let (b, n, d) = t.size3().expect("[B, n, d]");
        t.view([b, n, heads, d / heads]).transpose(1, 2) // [B, h, n, d/h]
    };
    // Strided as the linear layers leave them, of one kind, without a mask: so libtorch's fused kernels take them as they are, as
    // long as a head's width is a multiple of 8.
    Tensor::scaled_dot_product_attention(
        &split(q),
        &split(k),
        &split(v),
        None::<&Tensor>,
        0.,
        false,
        None,
        false,
    )
    .transpose(1, 2)
    .flatten(2, 3)
}
