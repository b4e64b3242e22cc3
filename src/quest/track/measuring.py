"""The signals of a frame, from which the monitor judges whether identities are still right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from quest.model.decoder import Anchor, Prediction
from quest.model.network import QuestNetwork
from quest.model.observation import Observation
from quest.monitor import SIGNALS, Signals
from quest.track.following import Following, as_rows
from quest.track.placing import Placed, as_array

_AWAY_CELLS = 3
_TOUCHING = 0.02
"""Queries that come closer than this are as good as in one place, reference units."""


def measure(
    network: QuestNetwork,
    anchor: Anchor,
    newest: Observation,
    prediction: Prediction,
    placed: Placed,
    uv: Float[Tensor, "K 2"],
    following: Sequence[Following],
) -> Signals:
    """Signals of K queries in one frame (B = T = 1).

    Args:
        network: the network, with a heatmap.
        anchor: what the queries are bound to.
        newest: the frame.
        prediction: answers of the network.
        placed: where the queries are.
        uv: the judged places in [0, 1]^2 of the input.
        following: the queries before they moved there.
    """
    head = network.head
    logits, embedding = prediction.logits[0, 0], prediction.embedding[0, 0].float()
    before, home = as_rows(f.place for f in following), as_rows(f.home for f in following)
    born = torch.stack([embedding[k] if f.born is None else f.born for k, f in enumerate(following)])
    best = as_array(newest.cell_point[0, 0, logits.argmax(dim=-1)])
    right = as_array(prediction.right_logit[0, 0])
    closing, lead = _rivals(placed.judged, home, right)
    values = {
        "anchor_cosine": as_array(_likeness(anchor.template, head.look.template(newest, uv[None].nan_to_num(0.5)))),
        "embedding_cosine": as_array(F.cosine_similarity(embedding, born, dim=-1)),
        "right_logit": right,
        "visible_logit": as_array(prediction.visible_logit[0, 0]),
        "peak_log_p": as_array(logits.log_softmax(dim=-1).amax(dim=-1)),
        "margin": as_array(_margin(logits, prediction.peak[0, 0], network.config.cells)),
        "disagreement": np.linalg.norm(best - placed.judged, axis=-1),
        "joint_residual": placed.residual,
        "depth_gap": placed.room,
        "step": np.linalg.norm(placed.judged - before, axis=-1),
        "spread": _spread(following),
        "held": placed.held.astype(np.float64),
        "travel": np.linalg.norm(placed.judged - home, axis=-1),
        "closing": closing,
        "lead": lead,
    }
    return Signals(np.stack([values[name] for name in SIGNALS], axis=-1).astype(np.float32))


def _likeness(template: Float[Tensor, "1 K M F"], now: Float[Tensor, "1 K M F"]) -> Float[Tensor, " K"]:
    """Mean over the anchor's surroundings of the cosine to what is most like it in the answer's."""
    return (template[0] @ now[0].transpose(-1, -2)).amax(dim=-1).mean(dim=-1)


def _margin(logits: Float[Tensor, "K C"], peak: Tensor, side: int) -> Float[Tensor, " K"]:
    """Score around the answer's cell less the best score away from it."""
    cell = torch.arange(side * side, device=logits.device)
    across = (cell % side)[None] - (peak % side)[:, None]
    down = cell.div(side, rounding_mode="floor")[None] - peak.div(side, rounding_mode="floor")[:, None]
    gap = torch.maximum(across.abs(), down.abs())
    near = torch.where(gap <= 1, logits, -torch.inf).amax(dim=-1)
    return near - torch.where(gap > _AWAY_CELLS, logits, -torch.inf).amax(dim=-1)


def _rivals(
    place: Float[np.ndarray, "K 3"], home: Float[np.ndarray, "K 3"], right: Float[np.ndarray, " K"]
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
    """How much nearer the other query is that came closest, and how much surer a query is than that one.

    Entities keep apart; who slips onto another that is followed too comes to where that one is.

    Args:
        place: where queries are; NaN where unknown.
        home: where they were first; NaN where unknown.
        right: log odds that each identity is right.

    Returns:
        Logarithm of the distance now to the distance at first, and the difference of log odds; NaN without another.
    """
    now, first = (np.linalg.norm(at[:, None] - at[None], axis=-1) for at in (place, home))
    closing = np.log((now + _TOUCHING) / (first + _TOUCHING))
    np.fill_diagonal(closing, np.nan)
    closing = np.where(np.isnan(closing), np.inf, closing)
    rival, least = closing.argmin(axis=1), closing.min(axis=1)
    alone = np.isinf(least)
    return np.where(alone, np.nan, least), np.where(alone, np.nan, right - right[rival])


def _spread(following: Sequence[Following]) -> np.ndarray:
    """Standard deviation of the beliefs in space; NaN without depth."""
    found = np.full(len(following), np.nan)
    for k, query in enumerate(following):
        if query.belief is None:
            continue
        point = as_array(query.belief.cell_point)
        known = np.isfinite(point).all(axis=1)
        weight = as_array(query.belief.probability[0])[known]
        if weight.sum() > 1e-6:
            weight = weight / weight.sum()
            mean = weight @ point[known]
            found[k] = np.sqrt(weight @ np.square(point[known] - mean).sum(axis=1))
    return found
