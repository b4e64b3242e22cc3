"""Where every query goes next: the 3D displacement from a window's newest frame to the frame after it.

The frame after it is one step on, and a step is whatever lies between the frames of the window: the head is told of no
clock, it sees motion per step and answers for one more. Most things rest most of the time, and a head is never quite
still: what it answers below :data:`REST` is rest, but while it learns.
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

    It starts out by saying that nothing moves.

    Args:
        width: of the embeddings.
        window: T, frames of a window.
    """

    def __init__(self, width: int, *, window: int) -> None:
        super().__init__()
        d = width
        self.window = window
        self.norm = nn.LayerNorm(d)
        self.frame = nn.Linear(d, d)
        self.age = nn.Parameter(0.02 * torch.randn(window, d))
        self.fuse = nn.Linear(window * d, d)
        final = nn.Linear(d, 3)
        self.out = nn.Sequential(nn.GELU(), nn.Linear(d, d), nn.GELU(), final)
        nn.init.zeros_(final.weight)
        nn.init.zeros_(final.bias)

    def forward(self, embedding: Float[Tensor, "B T K D"]) -> Float[Tensor, "B K 3"]:
        """Displacement to the next frame, in units of the reference frame.

        Args:
            embedding: the queries after the decoder, oldest first; at most the window's frames. At the start of a
                stream, before there are so many, the oldest stands for those before it.
        """
        missing = self.window - embedding.shape[1]
        embedding = torch.cat((embedding[:, :1].expand(-1, missing, -1, -1), embedding), dim=1)
        x = F.gelu(self.frame(self.norm(embedding)) + self.age[:, None])
        flow = self.out(self.fuse(x.transpose(1, 2).flatten(2))).float()
        return flow if self.training else torch.where(flow.norm(dim=-1, keepdim=True) < REST, 0.0, flow)
