"""Every frame matched to the query's own by a volume of costs: of the kind of TAP-Net.

Reference: Doersch et al., TAP-Vid: A Benchmark for Tracking Any Point in a Video, NeurIPS 2022. The features at a
query's pixel are compared with those everywhere in a frame; convolutions turn these costs into a map, whose mean around
its highest place is the answer, and into whether the point is seen. Frames know nothing of each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from quest.baselines.retrained.layers import ConvEncoder, as_maps, read_at
from quest.baselines.retrained.windows import PointNetwork, PointTruth, PointWindow, ShownConfig
from quest.train.losses import masked_mean

STRIDE = 4
_AROUND = 5
"""Cells from the highest place that the mean is taken over; as published."""
_SHARPNESS = 10.0
"""Times the map before its softmax; as published."""


@dataclass(frozen=True, kw_only=True)
class MatcherConfig(ShownConfig):
    """Shapes."""

    frames: int = 4
    """Of a window to learn from."""
    width: int = 64
    """Channels that are compared."""
    hidden: int = 16
    """Channels of what is made of the costs."""


class MatcherNetwork(PointNetwork):
    """Maps the features at points and a frame to their places in it."""

    config: MatcherConfig

    def __init__(self, config: MatcherConfig) -> None:
        super().__init__()
        self.config = config
        h = config.hidden
        self.features = ConvEncoder(config.width, stride=STRIDE)
        self.costs = nn.Conv2d(1, h, 3, padding=1)
        self.map = nn.Conv2d(h, 1, 3, padding=1)
        self.seen = nn.Sequential(nn.Conv2d(h, 2 * h, 3, 2, 1), nn.ReLU())
        self.visible = nn.Sequential(nn.Linear(2 * h, h), nn.ReLU(), nn.Linear(h, 1))

    def encode(self, rgb: Tensor) -> Float[Tensor, "B C h w"]:
        """Unit features of pictures."""
        return F.normalize(self.features(as_maps(rgb)), dim=1)

    def match(
        self, query: Float[Tensor, "B N C"], maps: Float[Tensor, "B C h w"]
    ) -> tuple[Float[Tensor, "B N h w"], Float[Tensor, "B N"]]:
        """A map of where each query is in one frame each, and log odds that it is seen."""
        costs = torch.einsum("bnc,bcij->bnij", query, maps)
        x = F.relu(self.costs(costs.flatten(0, 1).unsqueeze(1)))
        where = self.map(x)[:, 0].float().unflatten(0, costs.shape[:2])
        logit = self.visible(self.seen(x).mean((-2, -1)))[..., 0].float().unflatten(0, costs.shape[:2])
        return _SHARPNESS * where, logit

    def follow(self, window: PointWindow) -> tuple[Float[Tensor, "B S N 2"], Float[Tensor, "B S N"]]:
        """Frame by frame."""
        where, logit = self._matched(window)
        return place_of(where), logit

    def losses(self, window: PointWindow, truth: PointTruth) -> dict[str, Float[Tensor, ""]]:
        """Huber's of places and cross-entropy of "seen", as published, and cross-entropy of the cell of a seen point.

        The last is not published: the first teaches nothing where the highest place is far off, and a hundred times as
        many steps as are made here would have to wait for it.
        """
        where, logit = self._matched(window)
        seen = truth.visible
        gap = F.smooth_l1_loss(place_of(where), truth.uv_px, reduction="none", beta=STRIDE).sum(-1)
        side = where.shape[-1]
        cell = (truth.uv_px / STRIDE).long().clamp(0, side - 1)
        told = (cell[..., 1] * side + cell[..., 0]).unsqueeze(-1)
        log_p = where.flatten(-2).log_softmax(-1).gather(-1, told)[..., 0]
        entropy = F.binary_cross_entropy_with_logits(logit, seen.float(), reduction="none")
        return {
            "place": masked_mean(gap, seen),
            "cell": masked_mean(-log_p, seen),
            "seen": masked_mean(entropy, truth.known),
        }

    def _matched(self, window: PointWindow) -> tuple[Float[Tensor, "B S N h w"], Float[Tensor, "B S N"]]:
        b, s = window.rgb.shape[:2]
        maps = self.encode(window.rgb.flatten(0, 1))
        query = read_at(maps.unflatten(0, (b, s))[:, 0], window.uv_px, STRIDE).mT
        where, logit = self.match(query.repeat_interleave(s, dim=0), maps)
        return where.unflatten(0, (b, s)), logit.unflatten(0, (b, s))


def place_of(where: Float[Tensor, "*B h w"]) -> Float[Tensor, "*B 2"]:
    """The mean place around the highest one, pixels of the canvas."""
    h, w = where.shape[-2:]
    best = where.flatten(-2).argmax(-1)[..., None, None]
    row, column = torch.arange(h, device=where.device)[:, None], torch.arange(w, device=where.device)
    far = (row - best // w) ** 2 + (column - best % w) ** 2 > _AROUND**2
    p = where.masked_fill(far, -torch.inf).flatten(-2).softmax(-1).unflatten(-1, (h, w))
    x, y = (p.sum(-2) * (column + 0.5)).sum(-1), (p.sum(-1) * (row[:, 0] + 0.5)).sum(-1)
    return STRIDE * torch.stack((x, y), dim=-1)
