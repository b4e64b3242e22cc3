"""Where in the newest frame queries are: its match with the unchanged anchors, and what was known before it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from quest.model.decoder import Anchor, Prediction
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch, Observation, cell_centres
from quest.track.belief import Belief, moved, update
from quest.track.following import Following
from quest.track.placing import as_array
from quest.track.settings import TrackerConfig
from quest.track.surface import face

_BOUND_PX = 16.0
_BOUND_SIGMA_PX = 4.0
"""In the frame in which a query is bound its entity is this near to the pixel it was bound at, give or take; the
network may say where in there."""


def match(
    network: QuestNetwork,
    config: TrackerConfig,
    anchor: Anchor,
    window: Observation,
    frames: FrameBatch,
    following: Sequence[Following],
    *,
    elapsed: float,
) -> Prediction:
    """Answers of the network for the newest frame, at the cells that are best by all that is known.

    Args:
        network: the network, with a heatmap.
        config: settings of tracking.
        anchor: what the queries are bound to.
        window: the newest frames as observed.
        frames: the newest frame.
        following: the queries; their beliefs are renewed.
        elapsed: frames since the one before.
    """
    head = network.head
    x = network.embed(anchor, window)[:, -1:]
    newest = window.during(slice(-1, None))
    logits = head.logits(x, newest)
    seen = head.confidences(x, logits, newest, logits.argmax(dim=-1))[0, 0, :, 0].sigmoid()
    cell_point = newest.cell_point[0, 0].float()
    favour = torch.zeros_like(logits[0, 0])
    if config.ground:
        face(frames, following, elapsed=elapsed)
        place = cell_point.cpu().numpy()
        favour = torch.from_numpy(np.stack([f.ground.favour(place) for f in following])).to(logits)
    size = network.config.encoder.image_size
    cell_px = cell_centres(network.config, device=logits.device)
    cell_uv = 2 * cell_px / size - 1
    posterior = torch.empty_like(logits[0, 0])
    bound = [k for k, f in enumerate(following) if f.bound_px is not None]
    fresh = [k for k, f in enumerate(following) if k not in bound and (f.belief is None or (f.doubted and not f.good))]
    known = [k for k in range(len(following)) if k not in bound and k not in fresh]
    if bound:
        prior = _around([following[k] for k in bound], cell_px)
        posterior[bound] = update(prior, logits[0, 0, bound], seen[bound], favour[bound], config)
    if fresh:
        posterior[fresh] = update(None, logits[0, 0, fresh], seen[fresh], favour[fresh], config)
    if known:
        prior = _prior([following[k] for k in known], cell_point, cell_uv, config, elapsed)
        posterior[known] = update(prior, logits[0, 0, known], seen[known], favour[known], config)
    for query, probability in zip(following, posterior, strict=True):
        query.belief, query.bound_px = Belief(probability[None], cell_point), None
    return head(x, anchor, newest, posterior.clamp(min=1e-12).log()[None, None])


def _around(following: Sequence[Following], cell_px: Float[Tensor, "C 2"]) -> Float[Tensor, "K C"]:
    """Where queries may be that were bound in this very frame: flat about their pixel, and hardly anywhere else."""
    at = [f.bound_px for f in following if f.bound_px is not None]
    beyond = (torch.cdist(torch.stack(at).to(cell_px), cell_px) - _BOUND_PX).clamp(min=0)
    return (-0.5 * (beyond / _BOUND_SIGMA_PX) ** 2).softmax(dim=-1)


def _prior(
    following: Sequence[Following],
    cell_point: Float[Tensor, "C 3"],
    cell_uv: Float[Tensor, "C 2"],
    config: TrackerConfig,
    elapsed: float,
) -> Float[Tensor, "K C"]:
    """Where queries may be before the frame is looked at: near where they were seen, or where joints held them."""
    beliefs = [f.belief for f in following if f.belief is not None]
    before = Belief(torch.cat([b.probability for b in beliefs]), beliefs[0].cell_point)
    prior, place = moved(before, cell_point, cell_uv, config.move_sigma * elapsed), as_array(cell_point)
    for row, query in enumerate(following):
        if query.buried and query.place is not None:
            expected = query.ground.expected(query.place, place, elapsed)
            if expected is not None:
                prior[row] = torch.from_numpy(expected).to(prior)
    return prior
