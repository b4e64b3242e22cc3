"""Where every query goes next: the 3D displacement from a window's newest frame to the frame after it.

The frame after it is one step on, and a step is whatever lies between the frames of the window: the head is told of no
clock, it sees motion per step and answers for one more. What moves at an even pace needs no more than that, so the
answer is made of the steps that were seen, each with a weight of its own, and of a free rest. Most things rest most of
the time, and a head is never quite still: what it answers below :data:`REST` is rest, but while it learns.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

REST = 0.003
"""Displacements shorter than this, in units of the reference frame, are answered as 0."""


class FlowHead(nn.Module):
    """Scene flow of queries, from their embeddings in the frames of a window.

    With ``points3d`` it also sees the lifted points and may go on with their steps; without, as in the published
    network, embeddings are all there is. It starts out by saying that nothing moves.

    Args:
        width: of the embeddings.
        window: T, frames of a window.
        points3d: whether it sees points.
    """

    def __init__(self, width: int, *, window: int, points3d: bool) -> None:
        super().__init__()
        d = width
        self.window = window
        self.points3d = points3d and window > 1
        self.norm = nn.LayerNorm(d)
        self.frame = nn.Linear(d, d)
        self.age = nn.Parameter(0.02 * torch.randn(window, d))
        self.steps = nn.Linear(7 * (window - 1), d) if self.points3d else None
        self.fuse = nn.Linear(window * d, d)
        weights = window - 1 if self.points3d else 0
        self.out = nn.Sequential(nn.GELU(), nn.Linear(d, d), nn.GELU(), nn.Linear(d, weights + 3))
        final = self.out[-1]
        assert isinstance(final, nn.Linear)
        nn.init.zeros_(final.weight)
        nn.init.zeros_(final.bias)

    def forward(self, embedding: Float[Tensor, "B T K D"], point: Float[Tensor, "B T K 3"]) -> Float[Tensor, "B K 3"]:
        """Displacement to the next frame, in units of the reference frame.

        Args:
            embedding: the queries after the decoder, oldest first; at most the window's frames. At the start of a
                stream, before there are so many, the oldest stands for those before it.
            point: lifted points in the reference frame, NaN where there is none.
        """
        missing = self.window - embedding.shape[1]
        embedding = torch.cat((embedding[:, :1].expand(-1, missing, -1, -1), embedding), dim=1)
        point = torch.cat((point[:, :1].expand(-1, missing, -1, -1), point), dim=1).float()
        x = F.gelu(self.frame(self.norm(embedding)) + self.age[:, None])
        x = self.fuse(x.transpose(1, 2).flatten(2))
        if self.steps is None:
            return self._settled(self.out(x).float())
        step, seen = _steps(point)
        # Twice, so that a thousandth and a tenth of the reference frame are both of a size that a layer can read.
        code = torch.cat((10 * step.clamp(-1, 1), (100 * step).tanh(), seen.to(step.dtype)), dim=-1)
        out = self.out(x + self.steps(code.transpose(1, 2).flatten(2))).float()
        weight, rest = out[..., :-3], out[..., -3:]
        return self._settled((weight.transpose(1, 2).unsqueeze(-1) * step).sum(1) + rest)

    def _settled(self, flow: Float[Tensor, "B K 3"]) -> Float[Tensor, "B K 3"]:
        return flow if self.training else torch.where(flow.norm(dim=-1, keepdim=True) < REST, 0.0, flow)


def _steps(point: Float[Tensor, "B T K 3"]) -> tuple[Float[Tensor, "B S K 3"], Float[Tensor, "B S K 1"]]:
    """Steps between neighbouring frames, 0 where an end is not lifted, and whether both are (0 or 1)."""
    known = torch.isfinite(point).all(-1, keepdim=True)
    point = torch.where(known, point, torch.zeros_like(point))
    seen = known[:, 1:] & known[:, :-1]
    return torch.where(seen, point[:, 1:] - point[:, :-1], 0.0), seen.to(point.dtype)
