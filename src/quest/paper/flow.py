"""Stage 2: the flow head learns where entities go next, behind a backbone that stays as stage 1 left it.

The truth is the displacement from a window's newest frame to the frame after it at the window's own step, so time
enters through the window alone (see :mod:`quest.paper.network`): steps of one, two and three stored frames, standing
still and going backwards all ask for one more of the same. What is stored may be every sixth frame of a take; a stream
that gives every frame then has shorter steps than those that were learned from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from quest.model.frames import FrameBatch
from quest.paper.network import PaperNetwork
from quest.train.answers import Answered
from quest.train.losses import masked_mean
from quest.train.validation import mean_of
from quest.train.windows import WindowSampler, WindowTruth

_MOVING = 0.005
"""A displacement above this is motion rather than rest, normalised units per step."""


@dataclass(frozen=True)
class FlowScores:
    """EPE3D on fixed windows, normalised units per step of the window."""

    epe: float
    """Mean 3D distance of the predicted from the true displacement."""
    epe_moving: float
    """The same where the true displacement is above 0.005."""
    zero: float
    """Of saying that nothing moves."""
    zero_moving: float
    """The same where something does."""
    answers: int
    moving: int
    """How many of them move."""

    @property
    def score(self) -> float:
        """What a checkpoint is chosen by; less is better."""
        return self.epe

    def __str__(self) -> str:
        return (
            f"EPE3D {self.epe:.4f} (zero flow {self.zero:.4f}), moving {self.epe_moving:.4f} "
            f"({self.zero_moving:.4f}) (n = {self.answers}, {self.moving} moving)"
        )


class StageTwo:
    """Stage 2: L1 on scene flow of a network with a flow head; ``answered`` gives its answers for entities."""

    name = "stage-2"

    def __init__(self, network: PaperNetwork, answered: Callable[[FrameBatch, WindowTruth], Answered]) -> None:
        self.network = network
        self.weights = {"flow": 1.0}
        self._answered = answered

    def trained(self) -> list[nn.Parameter]:
        """The flow head's parameters."""
        assert self.network.flow is not None
        return list(self.network.flow.parameters())

    def refined(self) -> list[nn.Parameter]:
        """None: the encoder stays as it is."""
        return []

    def losses(self, frames: FrameBatch, truth: WindowTruth) -> dict[str, Float[Tensor, ""]]:
        """L1 of the displacement; what rests counts like what moves, or it would be said to move a little."""
        flow, judged = self._answer(frames, truth)
        error = (flow - truth.flow.nan_to_num()).abs().sum(-1) / truth.unit[:, None]
        return {"flow": masked_mean(error, judged)}

    def validate(self, sampler: WindowSampler, *, batches: int, device: torch.device) -> FlowScores:
        """EPE3D on the same windows at every call, beside zero flow."""
        rng, errors, lengths = np.random.default_rng(0), [], []
        self.network.eval()
        with torch.no_grad():
            for _ in range(batches):
                frames, truth = sampler.draw(rng, disturb=False)
                frames, truth = frames.to(device), truth.to(device)
                flow, judged = self._answer(frames, truth)
                for parts, way in ((errors, flow - truth.flow), (lengths, truth.flow)):
                    parts.append((way.norm(dim=-1) / truth.unit[:, None])[judged].float().cpu())
        self.network.train()
        error, length = torch.cat(errors), torch.cat(lengths)
        moving = length > _MOVING
        epe, epe_moving, zero, zero_moving = (
            mean_of(part) or 0.0 for part in (error, error[moving], length, length[moving])
        )
        return FlowScores(epe, epe_moving, zero, zero_moving, answers=len(error), moving=int(moving.sum()))

    def _answer(self, frames: FrameBatch, truth: WindowTruth) -> tuple[Float[Tensor, "B K 3"], Bool[Tensor, "B K"]]:
        """Displacements, and which of them count."""
        with torch.no_grad():
            answers = self._answered(frames, truth)
        return self.network.displace(answers.embedding), answers.mask[:, -1] & torch.isfinite(truth.flow).all(-1)


def with_flow_head(network: PaperNetwork) -> PaperNetwork:
    """The network with a flow head: its own, or a new one that says that nothing moves."""
    return network if network.flow is not None else _rebuilt(network, flow=True)


def without_flow_head(network: PaperNetwork) -> PaperNetwork:
    """The network as stage 1 trains it: a flow head would be left behind by a backbone that moves on."""
    return network if network.flow is None else _rebuilt(network, flow=False)


def _rebuilt(network: PaperNetwork, *, flow: bool) -> PaperNetwork:
    other = PaperNetwork(replace(network.config, flow=flow))
    own = network.state_dict()
    other.load_state_dict({name: own.get(name, tensor) for name, tensor in other.state_dict().items()})
    return other.train(network.training)
