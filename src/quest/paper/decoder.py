"""A layer of the decoder, in which queries look at frames, at each other and back in time."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn


class Attention(nn.Module):
    """Multi-head attention with pre-norm on the queries.

    Shapes: B batch, Q queries, N keys, D width.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.q = nn.Linear(width, width)
        self.kv = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)

    def forward(
        self,
        x: Float[Tensor, "B Q D"],
        memory: Float[Tensor, "B N D"] | None = None,
        mask: Bool[Tensor, "Q N"] | None = None,
    ) -> Float[Tensor, "B Q D"]:
        """What the queries read from the memory (from themselves if None), to be added to ``x``.

        Args:
            x: queries.
            memory: keys and values, already normalised.
            mask: True where a query may look at a key; every query must be allowed at least one.
        """
        b, n, d = x.shape
        normed = self.norm(x)
        kv = self.kv(normed if memory is None else memory)
        q = self.q(normed).reshape(b, n, self.heads, -1).transpose(1, 2)
        k, v = kv.reshape(b, kv.shape[1], 2, self.heads, -1).permute(2, 0, 3, 1, 4)
        read = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return self.out(read.transpose(1, 2).reshape(b, n, d))


class FeedForward(nn.Module):
    """Pre-norm MLP with one hidden layer of four times the width."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)

    def forward(self, x: Float[Tensor, "*B D"]) -> Float[Tensor, "*B D"]:
        """To be added to ``x``."""
        return self.fc2(F.gelu(self.fc1(self.norm(x))))


class DecoderLayer(nn.Module):
    """Queries look at one frame, at each other, and at themselves in earlier frames."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.look = Attention(width, heads)
        self.remember = Attention(width, heads)
        self.compare = Attention(width, heads)
        self.mlp = FeedForward(width)

    def forward(self, x: Float[Tensor, "B T K D"], tokens: Float[Tensor, "B T N D"]) -> Float[Tensor, "B T K D"]:
        """One round; a frame sees only itself and earlier frames."""
        b, t, k = x.shape[:3]
        flat = x.flatten(0, 1)
        flat = flat + self.look(flat, tokens.flatten(0, 1))
        flat = flat + self.compare(flat)
        x = flat.unflatten(0, (b, t))
        causal = torch.ones(t, t, dtype=torch.bool, device=x.device).tril()
        per_query = x.transpose(1, 2).flatten(0, 1)
        per_query = per_query + self.remember(per_query, mask=causal)
        x = per_query.unflatten(0, (b, k)).transpose(1, 2)
        return x + self.mlp(x)
