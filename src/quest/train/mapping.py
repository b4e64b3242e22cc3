"""Stage map: the affordance map learns what could be taken hold of, from single frames.

Its trunk shares nothing with what follows entities, so this stage changes no track of a given query. It needs
many objects rather than many frames of each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from quest.model.config import DEFAULT
from quest.model.discovery import RADIUS_CELLS, find_peaks
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch
from quest.train import losses
from quest.train.validation import match_at_anchor
from quest.train.windows import WindowSampler, WindowTruth
from quest.types import INTENTS, LABELS


@dataclass(frozen=True)
class MapScores:
    """Discovery in fixed frames: a peak is right if an entity of its label, not yet taken, is within 0.1 in 3D."""

    precision: float
    """Average precision over all peaks, the best first."""
    recall: float
    """Share of seen entities that any peak is right about."""
    intent: float
    """Share of those of which it is known rightly whether one opens or lifts by them."""
    present: int
    """How many entities are seen."""

    @property
    def score(self) -> float:
        """What a checkpoint is chosen by; less is better."""
        return 1 - self.precision

    def __str__(self) -> str:
        return (
            f"average precision {self.precision:.3f}, {self.recall:.1%} among the peaks, intent right "
            f"{self.intent:.1%} (n = {self.present})"
        )


class StageMap:
    """The affordance map alone.

    Args:
        network: a network whose map has a trunk of its own (see :func:`with_own_map`).
    """

    name = "stage-map"

    def __init__(self, network: QuestNetwork) -> None:
        self.network = network
        self.weights = {"map": 1.0}

    def trained(self) -> list[nn.Parameter]:
        """Trunk and head of the map."""
        trunk = self.network.affordance_trunk
        assert trunk is not None
        return [*trunk.parameters(), *self.network.affordance.parameters()]

    def losses(self, frames: FrameBatch, truth: WindowTruth) -> dict[str, Float[Tensor, ""]]:
        """Focal loss of the map, and its offsets."""
        found = self.network.afford(frames)
        visible = truth.visible & truth.exists[:, None]
        return {"map": losses.affordance_loss(found, truth.uv, truth.label, truth.intent, visible, truth.owner)}

    def validate(self, sampler: WindowSampler, *, batches: int, device: torch.device) -> MapScores:
        """Average precision on the same frames at every call."""
        rng = np.random.default_rng(0)
        self.network.eval()
        peaks: list[tuple[float, bool, bool]] = []
        present = 0
        with torch.no_grad():
            for _ in range(batches):
                frames, truth = sampler.draw(rng, disturb=False)
                frames, truth = frames.to(device), truth.to(device)
                for b in range(len(truth.unit)):
                    peaks += self._judge(frames, truth, b)
                    present += int((truth.visible[b, 0] & truth.exists[b]).sum())
        self.network.train()
        peaks.sort(key=lambda peak: -peak[0])
        right = np.array([hit for _, hit, _ in peaks])
        intent = np.array([known for _, hit, known in peaks if hit])
        precision = np.cumsum(right) / np.arange(1, len(right) + 1)
        return MapScores(
            precision=float(precision[right].sum() / max(present, 1)),
            recall=float(right.sum() / max(present, 1)),
            intent=float(intent.mean()) if len(intent) else 0.0,
            present=present,
        )

    def _judge(self, frames: FrameBatch, truth: WindowTruth, b: int) -> list[tuple[float, bool, bool]]:
        """Score of every peak, whether it is right, and whether its intent is."""
        network, one = self.network, frames.of(slice(b, b + 1))
        peaks = find_peaks(network, one, None, radius_cells=RADIUS_CELLS, mirror=False)
        found, seen = match_at_anchor(peaks, frames, truth, b)
        out = []
        for score, intent, e in zip(peaks.logit.tolist(), peaks.intent.tolist(), found.tolist(), strict=True):
            out.append((score, e >= 0, e >= 0 and intent == int(truth.intent[b, seen[e]])))
        return out


def with_own_map(network: QuestNetwork) -> QuestNetwork:
    """The network with a map of its own trunk, which begins with what the network observes frames by.

    Intents are learned by the map too. A network that knew none keeps queries that take no notice of them.
    """
    if network.affordance_trunk is not None:
        return network
    layers = DEFAULT.map_layers
    other = QuestNetwork(replace(network.config, map_layers=layers, intents=True))
    own, state = network.state_dict(), other.state_dict()
    begin = {f"affordance_trunk.{name}": tensor for name, tensor in network.state_dict().items()
             if name.startswith("observer.")}  # fmt: skip
    for name, tensor in state.items():
        old = own.get(name, begin.get(name))
        if old is not None and old.shape == tensor.shape:
            state[name] = old
    if not network.config.intents:
        state["binder.intent.weight"] = torch.zeros_like(state["binder.intent.weight"])
        # Both purposes begin with what the one map knows.
        for name in ("affordance.mlp.2.weight", "affordance.mlp.2.bias"):
            scores, offsets = own[name].split([len(LABELS), 2])
            state[name] = torch.cat(
                (scores.repeat_interleave(len(INTENTS), 0), offsets.repeat(len(INTENTS), *[1] * (offsets.ndim - 1)))
            )
    other.load_state_dict(state)
    return other.train(network.training)
