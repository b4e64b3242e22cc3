"""Pieces of a frame that stand out of planes, as candidates for handles and knobs, and the head that ranks them.

The affordance map tells what looks like a handle, the depth where something like one is, how long it is and where its
middle. Neither is enough: a map learned from some hundred objects takes table legs for handles, and what stands out of
a front may be a vent. A few numbers of both leave little to learn by heart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from quest.geometry import lift_depth
from quest.model.config import NetworkConfig
from quest.model.observation import FrameBatch
from quest.model.protrusions import MEASURES, Protrusion, find_protrusions
from quest.types import LABELS, Camera

PIECE_LABELS = ("handle", "knob")
"""What a piece may be."""
PIECES_APART_PX = 4.0
"""Pieces whose middles are closer are one piece before two planes."""

_ON_PX = 6.0
"""A peak that is closer to a pixel of a piece is on it."""
_AROUND_PX = 11
_INPUTS = len(MEASURES) + len(PIECE_LABELS)
_HIDDEN = 32
_MOST_SPREADS = 4.0
_GROUPS = (*LABELS, "on a piece", "blind")
"""Peaks of the map that are alike in how far their score can be trusted: by label where depth shows no piece under
them, then handles and knobs on a piece, then handles and knobs where depth is missing."""


@dataclass(frozen=True)
class Pieces:
    """What stands out in a frame."""

    uv_px: Float[Tensor, "P 2"]
    """Their middles, pixels of the network's input."""
    inputs: Float[Tensor, "P F"]
    """Their measures, then the best score of the map on them for each of PIECE_LABELS."""
    purpose: Int[Tensor, "P 2"]
    """For which purpose that score is, index into INTENTS."""
    shapes: tuple[Protrusion, ...]
    """Their pixels."""

    def under(self, uv_px: Float[Tensor, "K 2"]) -> Bool[Tensor, "K P"]:
        """Which pixels lie on which piece, or within a few pixels of it."""
        at = uv_px.cpu().numpy()
        on = np.zeros((len(at), len(self.shapes)), dtype=bool)
        for p, shape in enumerate(self.shapes):
            across, down = shape.columns + 0.5 - at[:, :1], shape.rows + 0.5 - at[:, 1:]
            on[:, p] = (np.square(across) + np.square(down)).min(axis=1) < _ON_PX**2
        return torch.from_numpy(on)


def find_pieces(frames: FrameBatch, scores: Float[Tensor, "L P S S"], config: NetworkConfig) -> Pieces:
    """What stands out of planes in one frame (B = T = 1).

    Args:
        frames: the frame.
        scores: the affordance map's logits of every label and purpose.
        config: of the network.
    """
    shapes = tuple(find_protrusions(_image(frames)))
    side, cell = config.cells, config.cell_px
    wanted = scores[[LABELS.index(label) for label in PIECE_LABELS]].float()
    near = F.max_pool2d(wanted, 3, 1, 1).flatten(2).cpu()
    best: list[Tensor] = []
    for shape in shapes:
        cells = np.unique(np.minimum(shape.rows // cell, side - 1) * side + np.minimum(shape.columns // cell, side - 1))
        best.append(near[..., torch.from_numpy(cells)].amax(dim=-1))
    score, purpose = torch.stack(best).max(dim=-1) if best else (torch.zeros(0, 2), torch.zeros(0, 2, dtype=torch.long))
    measures = np.array([shape.measures for shape in shapes], np.float32).reshape(len(shapes), len(MEASURES))
    uv_px = torch.tensor([shape.uv_px for shape in shapes], dtype=torch.float32).reshape(-1, 2)
    return Pieces(uv_px, torch.cat((torch.from_numpy(measures), score), dim=1), purpose, shapes)


def groups(
    frames: FrameBatch,
    uv_px: Float[Tensor, "K 2"],
    label: Int[Tensor, " K"],
    on_piece: Bool[Tensor, " K"],
) -> Int[Tensor, " K"]:
    """How far the score of each peak of the map can be trusted, as an index for :meth:`PieceHead.trust`.

    Args:
        frames: the frame (B = T = 1).
        uv_px: the peaks.
        label: their labels.
        on_piece: which handles and knobs among them are on a piece.
    """
    known = F.avg_pool2d((frames.depth_m[0] > 0).float(), _AROUND_PX, 1, _AROUND_PX // 2)[0]
    column, row = (uv_px[:, i].long().clamp(0, known.shape[1 - i] - 1) for i in (0, 1))
    blind = known[row, column] < 0.5
    group = torch.where(on_piece, _GROUPS.index("on a piece"), label)
    return torch.where(may_be_piece(label) & blind, _GROUPS.index("blind"), group)


def may_be_piece(label: Int[Tensor, " K"]) -> Bool[Tensor, " K"]:
    """Which labels are those of pieces."""
    return torch.isin(label, torch.tensor([LABELS.index(name) for name in PIECE_LABELS], device=label.device))


class PieceHead(nn.Module):
    """Log odds that pieces are handles or knobs, and that peaks of the map are what they are taken for."""

    def __init__(self) -> None:
        super().__init__()
        self.mean = nn.Buffer(torch.zeros(_INPUTS))
        self.spread = nn.Buffer(torch.ones(_INPUTS))
        self.mlp = nn.Sequential(nn.Linear(_INPUTS, _HIDDEN), nn.SiLU(), nn.Linear(_HIDDEN, 1 + len(PIECE_LABELS)))
        self.gain = nn.Parameter(torch.ones(len(_GROUPS)))
        self.bias = nn.Parameter(torch.zeros(len(_GROUPS)))

    def classify(self, inputs: Float[Tensor, "P F"]) -> Float[Tensor, "P C"]:
        """Logits of being nothing, a handle, a knob."""
        normed = ((inputs - self.mean) / self.spread).clamp(-_MOST_SPREADS, _MOST_SPREADS)
        return self.mlp(normed)

    def forward(self, inputs: Float[Tensor, "P F"]) -> Float[Tensor, "P 2"]:
        """Log odds that each piece is a handle, or a knob."""
        chance = self.classify(inputs).log_softmax(dim=-1)
        others = torch.stack([chance[:, [0, 2]].logsumexp(dim=-1), chance[:, [0, 1]].logsumexp(dim=-1)], dim=-1)
        return chance[:, 1:] - others

    def trust(self, logit: Float[Tensor, " K"], group: Int[Tensor, " K"]) -> Float[Tensor, " K"]:
        """Log odds that peaks of the map are right.

        Args:
            logit: their scores.
            group: see :func:`groups`.
        """
        return self.gain[group] * logit + self.bias[group]


def _image(frames: FrameBatch) -> Float[np.ndarray, "H W 3"]:
    """What every pixel of the frame shows: camera axes, units of the reference frame, 0 where depth is missing."""
    depth = frames.depth_m[0, 0].cpu().double() / float(frames.scale[0])
    camera = Camera(*frames.intrinsics[0].tolist(), width=depth.shape[1], height=depth.shape[0])
    return lift_depth(depth, camera).nan_to_num().numpy()
