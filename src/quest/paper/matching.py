"""Which slot answers for which entity: the cost that training and tracking assign learned queries by."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor

COORDINATE_WEIGHT = 5.0
"""What the whole width of the image costs, in probabilities."""


def slot_cost(
    uv: Float[Tensor, "B T Q 2"],
    probability: Float[Tensor, "B T Q K"],
    target: Float[Tensor, "B T K 2"],
    seen: Bool[Tensor, "B T K"],
) -> Float[Tensor, "B K Q"]:
    """Cost of every slot for every entity: distance less probability, summed over the frames in which it is seen.

    References: Carion et al., End-to-End Object Detection with Transformers, ECCV 2020, equations 1 and 2, for one
    image; Wang et al., End-to-End Video Instance Segmentation with Transformers, CVPR 2021, section 3.3, for one
    assignment that holds in all frames of a clip.

    Args:
        uv: the slots' answers, in [0, 1]^2 of the input.
        probability: that a slot holds an entity like this one.
        target: where the entities are, in [0, 1]^2; anything where they are not seen.
        seen: which of them count.
    """
    gap = (uv.unsqueeze(-3) - target.unsqueeze(-2)).norm(dim=-1).float()
    cost = COORDINATE_WEIGHT * gap - probability.transpose(-1, -2).float()
    return torch.where(seen.unsqueeze(-1), cost, torch.zeros_like(cost)).sum(dim=1)


def assign_slots(
    cost: Float[Tensor, "B K Q"], wanted: Bool[Tensor, "B K"]
) -> tuple[Int[Tensor, "B K"], Bool[Tensor, "B K"]]:
    """Assign slots to entities by least total cost (Hungarian); none is assigned twice.

    Args:
        cost: of every slot for every entity.
        wanted: entities that ask for a slot.

    Returns:
        The slot of every entity (0 where it has none), and which have one: all that are wanted, while there are
        enough slots.
    """
    slot = torch.zeros(wanted.shape, dtype=torch.long)
    matched = torch.zeros(wanted.shape, dtype=torch.bool)
    table, asking = cost.detach().cpu().numpy(), wanted.cpu()
    for b in range(len(table)):
        entities = asking[b].nonzero().flatten()
        rows, columns = linear_sum_assignment(table[b, entities.numpy()])
        slot[b, entities[rows]] = torch.from_numpy(columns)
        matched[b, entities[rows]] = True
    return slot.to(cost.device), matched.to(cost.device)
