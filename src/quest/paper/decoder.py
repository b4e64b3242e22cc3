"""A layer of the decoder, in which queries look at frames, at each other and back in time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn


@dataclass(frozen=True)
class Tokens:
    """What a frame looks like: ``project(features) + place + time``, which is never formed for all N tokens."""

    features: Float[Tensor, "B T N E"]
    project: nn.Linear
    """From E to D."""
    place: Float[Tensor, "N D"]
    time: Float[Tensor, "T D"]


class Look(nn.Module):
    """Multi-head attention of K queries on the tokens of their frame, with pre-norm on the queries.

    Few queries look at many tokens, so what is linear in tokens is taken to the queries instead: keys into what they
    ask, values into what they have read. The answer is that of ordinary attention, at a tenth of the work.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.q = nn.Linear(width, width)
        self.k = nn.Linear(width, width, bias=False)
        self.v = nn.Linear(width, width)
        self.out = nn.Linear(width, width)

    def forward(
        self, x: Float[Tensor, "B T K D"], tokens: Tokens
    ) -> tuple[Float[Tensor, "B T K D"], Float[Tensor, "B T K N"]]:
        """What the queries read, to be added to ``x``, and where the first head read it."""
        q, key, value = (w.unflatten(axis, (self.heads, -1)) for w, axis in
                         ((self.q(self.norm(x)), -1), (self.k.weight, 0), (self.v.weight, 0)))  # fmt: skip
        q = q / math.sqrt(q.shape[-1])
        features, project, place = tokens.features, tokens.project, tokens.place
        asked = torch.einsum("btkhc,hce->btkhe", q, key @ project.weight).flatten(2, 3)
        # What is the same at all tokens, time and the bias of the projection, changes no attention.
        of_place = torch.einsum("btkhc,hcn->btkhn", q, key @ place.mT).flatten(2, 3)
        attention = (asked @ features.mT + of_place).softmax(-1)
        read = (attention @ features).unflatten(2, (-1, self.heads))
        at = attention.unflatten(2, (-1, self.heads))
        same = torch.einsum("td,hcd->thc", tokens.time + project.bias, value)[:, None]
        by_head = (
            torch.einsum("btkhe,hce->btkhc", read, value @ project.weight)
            + torch.einsum("btkhn,hcn->btkhc", at, value @ place.mT)
            + same
        )
        return self.out(by_head.flatten(3) + self.v.bias), attention[..., :: self.heads, :]


class Attention(nn.Module):
    """Multi-head attention of N vectors on themselves, with pre-norm."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def forward(self, x: Float[Tensor, "B N D"], mask: Bool[Tensor, "N N"] | None = None) -> Float[Tensor, "B N D"]:
        """What they read from each other, to be added to ``x``.

        Masks are True where one (rows) may look at another; each must be allowed at least one.
        """
        q, k, v = self.qkv(self.norm(x)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        read = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return self.out(read.transpose(1, 2).flatten(2))


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
        self.look = Look(width, heads)
        self.remember = Attention(width, heads)
        self.compare = Attention(width, heads)
        self.mlp = FeedForward(width)

    def forward(
        self, x: Float[Tensor, "B T K D"], tokens: Tokens
    ) -> tuple[Float[Tensor, "B T K D"], Float[Tensor, "B T K N"]]:
        """One round, and where queries looked; a frame sees only itself and earlier frames."""
        b, t, k = x.shape[:3]
        read, where = self.look(x, tokens)
        flat = (x + read).flatten(0, 1)
        x = (flat + self.compare(flat)).unflatten(0, (b, t))
        causal = torch.ones(t, t, dtype=torch.bool, device=x.device).tril()
        per_query = x.transpose(1, 2).flatten(0, 1)
        per_query = per_query + self.remember(per_query, mask=causal)
        x = per_query.unflatten(0, (b, k)).transpose(1, 2)
        return x + self.mlp(x), where
