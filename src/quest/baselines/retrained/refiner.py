"""Tracks of a window of frames, refined together again and again by a transformer: of the kind of CoTracker.

Reference: Karaev et al., CoTracker: It is Better to Track Together, ECCV 2024. A window's tracks begin where the window
before left them. In every round each point in each frame is a token of how its features correlate around its place by
now, where that is, and how it looks; tokens look at their own track and at all points of their frame, and mend place
and look. Windows overlap by half.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from quest.baselines.retrained.layers import ConvEncoder, as_maps, read_at, square, waves
from quest.baselines.retrained.windows import PointNetwork, PointTruth, PointWindow, ShownConfig
from quest.train.losses import masked_mean

STRIDE = 4
_DISCOUNT = 0.8
"""Weight of a round's loss, as a share of the next one's; as published."""
_WAVES = 4


@dataclass(frozen=True, kw_only=True)
class RefinerConfig(ShownConfig):
    """Shapes."""

    frames: int = 12
    """Of clips to learn from: two windows that overlap by half."""
    window: int = 8
    """Frames that are refined together."""
    width: int = 64
    """Channels of the features."""
    inner: int = 128
    """Channels of the transformer."""
    layers: int = 3
    """Of the transformer, each along tracks and across points."""
    levels: int = 3
    """Of the pyramid of features."""
    radius: int = 2
    """Cells around a place that are read, at every level."""
    rounds: int = 4
    """Of refinement."""


@dataclass(frozen=True)
class Window:
    """Tracks of N points in the frames of one window."""

    uv_px: Float[Tensor, "B S N 2"]
    look: Float[Tensor, "B S N C"]
    """Features that each is known by."""
    logit: Float[Tensor, "B S N"]
    """Log odds that each is seen."""

    def first(self, frames: int) -> Window:
        """Its first frames."""
        return Window(self.uv_px[:, :frames], self.look[:, :frames], self.logit[:, :frames])


class _Block(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.attentions = nn.ModuleList(nn.MultiheadAttention(width, 4, batch_first=True) for _ in range(2))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(3))
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, x: Float[Tensor, "B S N D"]) -> Float[Tensor, "B S N D"]:
        for axis in (2, 1):  # along its own track first, then across the points of its frame
            y = x.transpose(1, 2) if axis == 2 else x
            z = self.norms[axis - 1](y).flatten(0, 1)
            z = self.attentions[axis - 1](z, z, z, need_weights=False)[0].unflatten(0, y.shape[:2])
            x = x + (z.transpose(1, 2) if axis == 2 else z)
        return x + self.mlp(self.norms[2](x))


class RefinerNetwork(PointNetwork):
    """Maps the features of a window's frames and rough tracks to better ones."""

    config: RefinerConfig

    def __init__(self, config: RefinerConfig) -> None:
        super().__init__()
        self.config = config
        d, read = config.inner, config.levels * (2 * config.radius + 1) ** 2
        self.features = ConvEncoder(config.width, stride=STRIDE)
        self.correlations = nn.Sequential(nn.Linear(read, d), nn.GELU(), nn.Linear(d, d))
        self.take = nn.Linear(d + config.width + 1 + 2 * (2 + 4 * _WAVES), d)
        self.time = nn.Parameter(0.02 * torch.randn(config.window, 1, d))
        self.blocks = nn.ModuleList(_Block(d) for _ in range(config.layers))
        last = nn.Linear(d, 2 + config.width)
        self.give = nn.Sequential(nn.LayerNorm(d), last)
        self.seen = nn.Linear(config.width, 1)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def encode(self, rgb: Tensor) -> Float[Tensor, "B C h w"]:
        """Features of pictures."""
        return self.features(as_maps(rgb))

    def begin(self, maps: Float[Tensor, "B S C h w"], uv_px: Float[Tensor, "B N 2"]) -> Window:
        """Tracks that stand still at their places in the first frame."""
        s = maps.shape[1]
        look = read_at(maps[:, 0], uv_px, STRIDE).mT
        still = uv_px[:, None].expand(-1, s, -1, -1)
        return Window(still, look[:, None].expand(-1, s, -1, -1), torch.zeros_like(still[..., 0]))

    def slide(self, window: Window, frames: int) -> Window:
        """The window some frames on: its later frames as they are, the last one for those that are new."""

        def slid(x: Tensor) -> Tensor:
            return torch.cat((x[:, frames:], *[x[:, -1:]] * frames), dim=1)

        return Window(slid(window.uv_px), slid(window.look), slid(window.logit))

    def refine(self, maps: Float[Tensor, "B S C h w"], window: Window) -> list[Window]:
        """After every round; a window at a clip's end may be short."""
        s = maps.shape[1]
        pyramid = [maps.flatten(0, 1)]
        for _ in range(self.config.levels - 1):
            pyramid.append(F.avg_pool2d(pyramid[-1], 2))
        uv, look, logit, found = window.uv_px, window.look, window.logit, []
        size = self.config.image_size
        for _ in range(self.config.rounds):
            uv = uv.detach()
            correlated = self.correlations(self._look(pyramid, uv, look))
            way = waves((uv - uv[:, :1]) / STRIDE / 16, _WAVES), waves(uv / size - 0.5, _WAVES)
            x = self.take(torch.cat((correlated, look, logit.detach()[..., None], *way), dim=-1)) + self.time[:s]
            for block in self.blocks:
                x = block(x)
            out = self.give(x).float()
            uv, look = uv + STRIDE * out[..., :2], look + out[..., 2:]
            logit = self.seen(look)[..., 0].float()
            found.append(Window(uv, look, logit))
        return found

    def follow(self, window: PointWindow) -> tuple[Float[Tensor, "B S N 2"], Float[Tensor, "B S N"]]:
        """Window by window."""
        done = [(rounds[-1], new) for rounds, new in self._windows(window)]
        return (
            torch.cat([w.uv_px[:, new] for w, new in done], dim=1),
            torch.cat([w.logit[:, new] for w, new in done], dim=1),
        )

    def losses(self, window: PointWindow, truth: PointTruth) -> dict[str, Float[Tensor, ""]]:
        """L1 of places in pixels after every round, and cross-entropy of "seen" after the last, of every window."""
        places, seen, half = [], [], self.config.window // 2
        for i, (rounds, _) in enumerate(self._windows(window)):
            part = slice(i * half, i * half + rounds[-1].uv_px.shape[1])
            uv, known = truth.uv_px[:, part], truth.known[:, part]
            for j, each in enumerate(rounds):
                share = _DISCOUNT ** (len(rounds) - 1 - j)
                places.append(share * masked_mean((each.uv_px - uv).abs().sum(-1), known))
            entropy = F.binary_cross_entropy_with_logits(
                rounds[-1].logit, truth.visible[:, part].float(), reduction="none"
            )
            seen.append(masked_mean(entropy, known))
        return {"place": torch.stack(places).sum(), "seen": torch.stack(seen).sum()}

    def _windows(self, window: PointWindow) -> list[tuple[list[Window], slice]]:
        """All windows, and which of their frames no window before had."""
        b, s = window.rgb.shape[:2]
        maps, t = self.encode(window.rgb.flatten(0, 1)).unflatten(0, (b, s)), self.config.window
        done = [(self.refine(maps[:, :t], self.begin(maps[:, :t], window.uv_px)), slice(None))]
        for start in range(t // 2, s - t // 2, t // 2):
            part = maps[:, start : start + t]
            before = self.slide(done[-1][0][-1], t // 2).first(part.shape[1])
            done.append((self.refine(part, before), slice(t // 2, None)))
        return done

    def _look(
        self, pyramid: list[Tensor], uv_px: Float[Tensor, "B S N 2"], look: Float[Tensor, "B S N C"]
    ) -> Float[Tensor, "B S N R"]:
        around, at = square(self.config.radius, uv_px.device), uv_px.flatten(0, 1)[:, :, None]
        known, read = look.flatten(0, 1), []
        for i, maps in enumerate(pyramid):
            there = read_at(maps, at + around * STRIDE * 2**i, STRIDE * 2.0**i)
            read.append(torch.einsum("mnc,mcnr->mnr", known, there) / self.config.width**0.5)
        return torch.cat(read, dim=-1).unflatten(0, uv_px.shape[:2])
