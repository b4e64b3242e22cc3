"""What all of them learn by, and where their weights are kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from quest.baselines.retrained.flow import FlowConfig, FlowNetwork
from quest.baselines.retrained.matcher import MatcherConfig, MatcherNetwork
from quest.baselines.retrained.refiner import RefinerConfig, RefinerNetwork
from quest.baselines.retrained.windows import PointNetwork, PointSampler, PointTruth, PointWindow, ShownConfig
from quest.errors import WeightsError
from quest.model.encoder import read_into
from quest.model.tensor_file import read_tensors, save_half
from quest.train.validation import mean_of
from quest.untrusted import reading

FORMAT = "quest-retrained-1"
_FAR_PX = 32.0
"""Distance that is not told from a larger one."""


@dataclass(frozen=True)
class Kind:
    """One of the networks."""

    config: type[ShownConfig]
    network: Callable[[Any], PointNetwork]
    weights: Mapping[str, float]
    batch: int
    """Windows of a step."""


KINDS: dict[str, Kind] = {
    "raft-3d-retrained": Kind(FlowConfig, FlowNetwork, {"flow": 1.0, "rigid": 1.0}, 3),
    "tapnet-retrained": Kind(MatcherConfig, MatcherNetwork, {"place": 0.1, "cell": 1.0, "seen": 1.0}, 2),
    "cotracker-retrained": Kind(RefinerConfig, RefinerNetwork, {"place": 1.0, "seen": 2.0}, 1),
}
"""By the name of the tracker."""


@dataclass(frozen=True)
class PointScores:
    """Quality on fixed windows."""

    mean_px: float
    """Mean distance of points that are seen, at most 32 px each."""
    moved_px: float
    """The same of those that are more than 4 px from where they began."""
    seen: float
    """Share of right answers to whether a point is seen."""
    points: int
    """How many answers were judged."""

    @property
    def score(self) -> float:
        """What a checkpoint is chosen by; less is better."""
        return self.mean_px

    def __str__(self) -> str:
        return f"{self.mean_px:.2f} px (moved {self.moved_px:.2f}), seen {self.seen:.1%} (n = {self.points})"


class FollowPoints:
    """One of the networks as an objective of :func:`quest.train.loop.fit`."""

    def __init__(self, name: str, network: PointNetwork) -> None:
        self.name, self.network = name, network
        self.weights = dict(KINDS[name].weights)

    def trained(self) -> list[nn.Parameter]:
        """All parameters."""
        return list(self.network.parameters())

    def refined(self) -> list[nn.Parameter]:
        """None: everything is learned from nothing."""
        return []

    def losses(self, window: PointWindow, truth: PointTruth) -> dict[str, Float[Tensor, ""]]:
        """As of the network."""
        return self.network.losses(window, truth)

    def validate(self, sampler: PointSampler, *, batches: int, device: torch.device) -> PointScores:
        """Distance on the same windows at every call."""
        rng, gaps, ways, right = np.random.default_rng(0), [], [], []
        self.network.eval()
        with torch.no_grad():
            for _ in range(batches):
                window, truth = sampler.load(sampler.plan(rng, disturb=False))
                window, truth = window.to(device), truth.to(device)
                uv_px, logit = self.network.follow(window)
                judged = truth.visible[:, 1:]
                gaps.append((uv_px - truth.uv_px).norm(dim=-1)[:, 1:][judged].clamp(max=_FAR_PX).cpu())
                ways.append((truth.uv_px - truth.uv_px[:, :1]).norm(dim=-1)[:, 1:][judged].cpu())
                right.append(((logit > 0) == truth.visible)[:, 1:].float().flatten().cpu())
        self.network.train()
        gap, way, seen = torch.cat(gaps), torch.cat(ways), torch.cat(right)
        means = (mean_of(values) or 0.0 for values in (gap, gap[way > 4], seen))
        return PointScores(*means, points=len(gap))


def save_retrained(name: str, network: PointNetwork, path: Path, *, about: str) -> None:
    """Write a network in half precision, atomically."""
    words = {"format": FORMAT, "kind": name, "config": network.config.to_json(), "about": about, "licence": ""}
    save_half(network, path, metadata=words)


def read_retrained(name: str, path: Path) -> PointNetwork:
    """A network in evaluation mode.

    Raises:
        WeightsError: no such file, a torn one, or one of another network.
    """
    metadata, state = read_tensors(path)
    if metadata.get("format") != FORMAT or metadata.get("kind") != name:
        raise WeightsError(f"{path}: expected weights of {name}; `quest bench comparison` trains them")
    kind = KINDS[name]
    with reading(path, WeightsError, "train it again"):
        config = kind.config.from_json(metadata["config"])
    state = {key: tensor.float() for key, tensor in state.items()}
    return read_into(lambda: kind.network(config), state, what=f"weights {path}").eval()
