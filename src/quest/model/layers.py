"""Small parts of the decoder: attention, feed-forward, position codes, and the stem for details."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from quest.model.relief import RELIEF_CHANNELS


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
        mask: Bool[Tensor, "*#B Q N"] | None = None,
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
        if mask is not None:
            mask = mask.unsqueeze(-3)
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


class TokenLayer(nn.Module):
    """Self-attention and MLP over the tokens of one frame."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attention = Attention(width, heads)
        self.mlp = FeedForward(width)

    def forward(self, x: Float[Tensor, "B N D"]) -> Float[Tensor, "B N D"]:
        """Tokens that know of each other."""
        x = x + self.attention(x)
        return x + self.mlp(x)


class PointCode(nn.Module):
    """Position code of 3D points by Fourier features; a learned code stands for a missing point.

    Reference: Tancik et al., Fourier Features Let Networks Learn High Frequency Functions, NeurIPS 2020.
    """

    frequencies: Tensor

    def __init__(self, width: int, octaves: int = 6) -> None:
        super().__init__()
        frequencies = math.pi / 2 * 2.0 ** torch.arange(octaves)
        self.register_buffer("frequencies", frequencies, persistent=False)
        self.fc1 = nn.Linear(3 + 6 * octaves, width)
        self.fc2 = nn.Linear(width, width)
        self.missing = nn.Parameter(torch.zeros(width))

    def forward(self, point: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B D"]:
        """Codes of points in the reference frame; a NaN coordinate means missing."""
        valid = torch.isfinite(point).all(dim=-1, keepdim=True)
        point = torch.where(valid, point, torch.zeros_like(point)).clamp(-4, 4)
        phase = (point.unsqueeze(-1) * self.frequencies).flatten(-2)
        code = self.fc2(F.gelu(self.fc1(torch.cat((point, phase.sin(), phase.cos()), dim=-1))))
        return torch.where(valid, code, self.missing.to(code.dtype))


class DetailStem(nn.Module):
    """Fine detail that frozen patch tokens lack, from colours, lifted points and relief of every pixel.

    Input channels: 3 colours, 3 coordinates in the reference frame, 1 whether depth is there, and the relief.
    """

    channels = 7 + RELIEF_CHANNELS

    def __init__(self, close_width: int, fine_width: int, token_width: int) -> None:
        super().__init__()
        self.patchify = nn.Conv2d(self.channels, close_width, 4, 4)
        self.norm1 = nn.GroupNorm(8, close_width)
        self.down = nn.Conv2d(close_width, fine_width, 3, 2, 1)
        self.norm2 = nn.GroupNorm(8, fine_width)
        self.mix = nn.Conv2d(fine_width, fine_width, 3, 1, 1)
        self.norm3 = nn.GroupNorm(8, fine_width)
        self.to_token = nn.Conv2d(fine_width, token_width, 2, 2)

    def forward(
        self, image: Float[Tensor, "B S H W"]
    ) -> tuple[Float[Tensor, "B G Hc Wc"], Float[Tensor, "B F Hf Wf"], Float[Tensor, "B D Hp Wp"]]:
        """Features at one fourth, one eighth and one sixteenth of the resolution."""
        close = F.gelu(self.norm1(self.patchify(image)))
        x = F.gelu(self.norm2(self.down(close)))
        x = x + F.gelu(self.norm3(self.mix(x)))
        return close, x, self.to_token(x)
