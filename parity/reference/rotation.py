"""Conversions of rotations: 6D representation to matrix, matrix to quaternion and back."""

import torch


def normalize(v, eps):
    """Returns v / max(|v|, eps) over the last axis."""
    return v / v.norm(dim=-1, keepdim=True).clamp(min=eps)


def matrix_from_6d(six):
    """Converts 6D rotations [..., 6] to matrices [..., 3, 3] by Gram-Schmidt; b1, b2, b3 are the rows."""
    b1 = normalize(six[..., :3], 1e-8)
    b2 = six[..., 3:] - (b1 * six[..., 3:]).sum(-1, keepdim=True) * b1
    b2 = normalize(b2, 1e-8)
    b3 = torch.linalg.cross(b1, b2)
    return torch.stack([b1, b2, b3], dim=-2)


def quaternion_from_matrix(m):
    """Converts matrices [..., 3, 3] to quaternions [..., 4] as (w, x, y, z), w >= 0.

    The entries of 4 q q^T are sums of entries of the matrix. Row k of it is 4 q_k q; the row with the largest diagonal
    entry is the best conditioned.
    """
    m00, m01, m02 = m[..., 0, 0], m[..., 0, 1], m[..., 0, 2]
    m10, m11, m12 = m[..., 1, 0], m[..., 1, 1], m[..., 1, 2]
    m20, m21, m22 = m[..., 2, 0], m[..., 2, 1], m[..., 2, 2]
    ww, xx = 1 + m00 + m11 + m22, 1 + m00 - m11 - m22
    yy, zz = 1 - m00 + m11 - m22, 1 - m00 - m11 + m22
    wx, wy, wz = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m10 + m01, m02 + m20, m21 + m12
    outer = torch.stack(
        [
            torch.stack([ww, wx, wy, wz], dim=-1),
            torch.stack([wx, xx, xy, xz], dim=-1),
            torch.stack([wy, xy, yy, yz], dim=-1),
            torch.stack([wz, xz, yz, zz], dim=-1),
        ],
        dim=-2,
    )
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None]
    row = outer.gather(-2, largest.expand(*largest.shape[:-1], 4)).squeeze(-2)
    own = row.gather(-1, largest.squeeze(-1))  # 4 q_k^2
    q = row / (2.0 * torch.sqrt(own))
    return torch.where(q[..., :1] < 0, -q, q)


def matrix_from_quaternion(q):
    """Converts quaternions [..., 4] (w, x, y, z) of any nonzero norm to matrices [..., 3, 3]."""
    q = q / q.detach().abs().amax(-1, keepdim=True)  # so that squares neither overflow nor underflow
    w, x, y, z = (q / q.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=-1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=-1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=-1),
    ]
    return torch.stack(rows, dim=-2)
