"""Rigid transforms as 4 x 4 matrices, named ``target_from_source``.

Products are taken in the precision of their factors, also where a network computes in bfloat16 (``torch.autocast``):
eight bits of mantissa would be centimetres.

Reference: Murray, Li and Sastry, A Mathematical Introduction to Robotic Manipulation, chapter 2.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def transform(target_from_source: Float[Tensor, "*#B 4 4"], point: Float[Tensor, "*#B 3"]) -> Float[Tensor, "*B 3"]:
    """Points of the source frame in the target frame; leading axes broadcast."""
    rotated = exact_product(target_from_source[..., :3, :3], point.unsqueeze(-1)).squeeze(-1)
    return rotated + target_from_source[..., :3, 3]


def invert(target_from_source: Float[Tensor, "*B 4 4"]) -> Float[Tensor, "*B 4 4"]:
    """Inverse of a rigid transform, by its transposed rotation."""
    rotation_t = target_from_source[..., :3, :3].transpose(-1, -2)
    translation = -exact_product(rotation_t, target_from_source[..., :3, 3:])
    top = torch.cat((rotation_t, translation), dim=-1)
    bottom = torch.zeros_like(target_from_source[..., 3:, :])
    bottom[..., 3] = 1.0
    return torch.cat((top, bottom), dim=-2)


def exact_product(a: Float[Tensor, "*#B N M"], b: Float[Tensor, "*#B M P"]) -> Float[Tensor, "*B N P"]:
    """Matrix product that autocast leaves alone."""
    with torch.autocast(a.device.type, enabled=False):
        return a @ b
