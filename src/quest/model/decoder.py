"""Queries, the decoder that lets them look at every frame of the window, and the heads."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from quest.model.config import NetworkConfig
from quest.model.layers import Attention, FeedForward, PointCode
from quest.model.observation import Observation, Observer, cell_centres, gather_cells
from quest.model.second_look import SecondLook
from quest.types import INTENTS, LABELS


@dataclass(frozen=True)
class Anchor:
    """What queries are bound to; it never changes after binding."""

    content: Float[Tensor, "B K D"]
    """Embedding of the entity at the frame where it was bound."""
    template: Float[Tensor, "B K M F"]
    """What the close cells around it looked like there."""
    valid: Bool[Tensor, "B K"]
    """False for padding queries, which nothing attends to."""

    def join(self, other: Anchor) -> Anchor:
        """These queries and more."""
        return Anchor(
            torch.cat((self.content, other.content), dim=1),
            torch.cat((self.template, other.template), dim=1),
            torch.cat((self.valid, other.valid), dim=1),
        )

    def select(self, rows: Int[Tensor, " R"]) -> Anchor:
        """Some of these queries."""
        return Anchor(self.content[:, rows], self.template[:, rows], self.valid[:, rows])


@dataclass(frozen=True)
class Prediction:
    """Answers for every frame of a window."""

    embedding: Float[Tensor, "B T K D"]
    """The queries after the decoder."""
    logits: Float[Tensor, "B T K C"]
    """Score of every cell."""
    peak: Int[Tensor, "B T K"]
    """Best cell."""
    uv: Float[Tensor, "B T K 2"]
    """Coordinates in [0, 1]^2 of the input."""
    point: Float[Tensor, "B T K 3"]
    """Position in the reference frame; NaN where it cannot be lifted."""
    visible_logit: Float[Tensor, "B T K"]
    """Is the entity seen?"""
    right_logit: Float[Tensor, "B T K"]
    """Is the identity right?"""


class Binder(nn.Module):
    """Makes an anchor's content from a pixel: its features, its 3D point, a label, and what surrounds it."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        d = config.width
        self.content = nn.Linear(d + Observer.fine_width, d)
        self.place = nn.Linear(2, d)
        self.points = PointCode(d) if config.points3d else None
        self.label = nn.Embedding(len(LABELS) + 1, d)
        self.intent = nn.Embedding(len(INTENTS) + 1, d) if config.intents else None
        self.context = nn.ModuleList(Attention(d, config.heads) for _ in range(2))
        self.mlp = nn.ModuleList(FeedForward(d) for _ in range(2))

    def forward(
        self,
        observed: Observation,
        uv: Float[Tensor, "B K 2"],
        point: Float[Tensor, "B K 3"],
        label: Int[Tensor, "B K"],
        intent: Int[Tensor, "B K"],
    ) -> Float[Tensor, "B K D"]:
        """Content of the anchors of queries that are bound at one frame.

        Args:
            observed: that frame (T = 1).
            uv: where, in [0, 1]^2 of the input.
            point: lifted position in the reference frame, NaN if unknown.
            label: index into LABELS, or ``len(LABELS)`` if unknown.
            intent: index into INTENTS, or ``len(INTENTS)`` if unknown.
        """
        tokens = observed.tokens[:, 0]
        coarse = sample_grid(tokens, uv, self.config.encoder.grid)
        fine = sample_grid(observed.fine[:, 0], uv, self.config.cells)
        x = self.content(torch.cat((coarse, fine), dim=-1)) + self.place(2 * uv - 1) + self.label(label)
        if self.intent is not None:
            x = x + self.intent(intent)
        if self.points is not None:
            x = x + self.points(point)
        for attention, mlp in zip(self.context, self.mlp, strict=True):
            x = x + attention(x, tokens)
            x = x + mlp(x)
        return x


class DecoderLayer(nn.Module):
    """Queries look at one frame, at each other, and at themselves in earlier frames."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.look = Attention(width, heads)
        self.remember = Attention(width, heads)
        self.compare = Attention(width, heads)
        self.mlp = FeedForward(width)

    def forward(
        self, x: Float[Tensor, "B T K D"], tokens: Float[Tensor, "B T N D"], valid: Bool[Tensor, "B K"]
    ) -> Float[Tensor, "B T K D"]:
        """One round; a frame sees only itself and earlier frames."""
        b, t, k = x.shape[:3]
        flat = x.flatten(0, 1)
        flat = flat + self.look(flat, tokens.flatten(0, 1))
        # A padding query may see itself, so that no row of the mask is empty.
        mask = valid[:, None, :] | torch.eye(k, dtype=torch.bool, device=x.device)
        flat = flat + self.compare(flat, mask=mask.repeat_interleave(t, dim=0))
        x = flat.unflatten(0, (b, t))
        causal = torch.ones(t, t, dtype=torch.bool, device=x.device).tril()
        per_query = x.transpose(1, 2).flatten(0, 1)
        per_query = per_query + self.remember(per_query, mask=causal)
        x = per_query.unflatten(0, (b, k)).transpose(1, 2)
        return x + self.mlp(x)


class HeatmapHead(nn.Module):
    """A score per cell, then a second look around the best one."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        f = Observer.fine_width
        self.key = nn.Linear(config.width, f)
        self.look = SecondLook(config)
        self.judge = nn.Sequential(nn.Linear(config.width + f + 2, f), nn.GELU(), nn.Linear(f, 2))

    def logits(self, x: Float[Tensor, "B T K D"], observed: Observation) -> Float[Tensor, "B T K C"]:
        """Match of every query with every cell."""
        return (self.key(x) @ observed.fine.transpose(-1, -2)).float() * Observer.fine_width**-0.5

    def refine(
        self,
        x: Float[Tensor, "B T K D"],
        anchor: Anchor,
        scores: Float[Tensor, "B T K C"],
        observed: Observation,
        peak: Int[Tensor, "B T K"],
    ) -> tuple[Float[Tensor, "B T K 2"], Float[Tensor, "B T K 3"]]:
        """Coordinates in [0, 1]^2 and reference point, by a second look at the mean of 3 x 3 cells around a peak."""
        side = self.config.cells
        step = torch.tensor([-1, 0, 1], device=peak.device)
        row = (peak.div(side, rounding_mode="floor")[..., None, None] + step[:, None]).clamp(0, side - 1)
        column = ((peak % side)[..., None, None] + step[None, :]).clamp(0, side - 1)
        index = (row * side + column).flatten(-2)
        weight = scores.detach().gather(-1, index).softmax(dim=-1).unsqueeze(-1)
        centre = cell_centres(self.config, device=peak.device)[index]
        uv = (weight * centre).sum(-2) / self.config.encoder.image_size
        return self.look(x, anchor.template, anchor.valid, observed, uv)

    def forward(
        self,
        x: Float[Tensor, "B T K D"],
        anchor: Anchor,
        observed: Observation,
        scores: Float[Tensor, "B T K C"] | None = None,
    ) -> Prediction:
        """Everything at the best cell.

        Args:
            x: the queries after the decoder.
            anchor: what they are bound to.
            observed: the frames.
            scores: what decides on the best cell and weighs its neighbours; the logits if None.
        """
        logits = self.logits(x, observed)
        scores = logits if scores is None else scores
        peak = scores.argmax(dim=-1)
        uv, point = self.refine(x, anchor, scores, observed, peak)
        visible, right = self.confidences(x, logits, observed, peak).unbind(-1)
        return Prediction(x, logits, peak, uv, point, visible, right)

    def confidences(
        self,
        x: Float[Tensor, "B T K D"],
        logits: Float[Tensor, "B T K C"],
        observed: Observation,
        peak: Int[Tensor, "B T K"],
    ) -> Float[Tensor, "B T K 2"]:
        """Logits of "seen" and "identity right" at a peak; they learn from the answer, the answer never from them."""
        log_p = logits.log_softmax(dim=-1)
        entropy = -(log_p.exp() * log_p).sum(-1, keepdim=True)
        at_peak = log_p.gather(-1, peak.unsqueeze(-1))
        fine = gather_cells(observed.fine, peak.unsqueeze(-1)).squeeze(-2)
        return self.judge(torch.cat((x, fine, at_peak, entropy), dim=-1).detach()).float()


def sample_grid(cells: Float[Tensor, "B N D"], uv: Float[Tensor, "B K 2"], side: int) -> Float[Tensor, "B K D"]:
    """Bilinear samples of a square grid of vectors at coordinates in [0, 1]^2."""
    grid = cells.transpose(1, 2).unflatten(2, (side, side))
    place = (2 * uv - 1).unsqueeze(1).to(grid.dtype)
    sampled = F.grid_sample(grid, place, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled.squeeze(2).transpose(1, 2)
