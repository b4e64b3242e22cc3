"""Flow by recurrent steps over all pairs of tokens, lifted and made rigid in 3D: of the kind of RAFT and RAFT-3D.

References: Teed and Deng, RAFT, ECCV 2020, and RAFT-3D: Scene Flow using Rigid-Motion Embeddings, CVPR 2021. Every
token correlates with every other one; a recurrent unit reads the correlations around where the flow leads by now, and
mends the flow, the trust in it, and an embedding that is alike for what moves alike. A point then moves as one rigid
body with all tokens of like embedding, as far as these are trusted: two Gauss-Newton steps on their lifted pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from quest.baselines.retrained.layers import ConvEncoder, as_maps, mesh, read_at, square
from quest.baselines.retrained.windows import PointNetwork, PointTruth, PointWindow, ShownConfig
from quest.model.frames import depth_at
from quest.train.losses import masked_mean

STRIDE = 8
_DISCOUNT = 0.8
"""Weight of a step's loss, as a share of the next one's; as published."""


@dataclass(frozen=True, kw_only=True)
class FlowConfig(ShownConfig):
    """Shapes."""

    frames: int = 2
    """Of a window to learn from."""
    width: int = 96
    """Channels that are correlated."""
    hidden: int = 64
    """Channels of the recurrent unit."""
    levels: int = 3
    """Of the pyramid of correlations."""
    radius: int = 3
    """Tokens around the flow that are read, at every level."""
    steps: int = 6
    """Of the recurrent unit."""
    embedding: int = 16
    """Channels by which bodies are told apart."""


class FlowNetwork(PointNetwork):
    """Maps two frames with depth to the way of points from one to the other."""

    config: FlowConfig

    def __init__(self, config: FlowConfig) -> None:
        super().__init__()
        self.config = config
        h, read = config.hidden, config.levels * (2 * config.radius + 1) ** 2
        self.features = ConvEncoder(config.width, stride=STRIDE)
        self.context = ConvEncoder(2 * h, stride=STRIDE, channels=4)
        self.motion = nn.Sequential(nn.Conv2d(read + 3, h, 1), nn.ReLU(), nn.Conv2d(h, h, 3, padding=1), nn.ReLU())
        self.gates = nn.Conv2d(3 * h, 2 * h, 3, padding=1)
        self.candidate = nn.Conv2d(3 * h, h, 3, padding=1)
        self.delta = nn.Sequential(nn.Conv2d(h, h, 3, padding=1), nn.ReLU(), nn.Conv2d(h, 2, 3, padding=1))
        self.mask = nn.Sequential(nn.Conv2d(h, h, 3, padding=1), nn.ReLU(), nn.Conv2d(h, 9 * STRIDE**2, 1))
        self.bodies = nn.Sequential(nn.Conv2d(h, h, 3, padding=1), nn.ReLU(), nn.Conv2d(h, config.embedding + 1, 1))

    def forward(self, window: PointWindow) -> tuple[list[Float[Tensor, "B N 2"]], Float[Tensor, "B N 2"]]:
        """Where the points of the first frame are in the second: after every step by flow, and last as rigid bodies."""
        b, (rgb, depth_m) = len(window.rgb), (window.rgb[:, :2], window.depth_m[:, :2])
        maps = self.features(as_maps(rgb).flatten(0, 1)).unflatten(0, (b, 2))
        inverse = torch.where(depth_m > 0, 1 / depth_m.clamp(min=0.05), 0.0)
        hidden, given = self.context(torch.cat((as_maps(rgb[:, 0]), inverse[:, :1]), dim=1)).chunk(2, dim=1)
        hidden, given = hidden.tanh(), given.relu()
        pyramid = self._pyramid(maps)
        place = _places(maps)
        depth = read_at(inverse[:, :1], place, 1.0)
        flow, answers = torch.zeros_like(hidden[:, :2]), []
        for _ in range(self.config.steps):
            flow = flow.detach()
            ahead = place + flow.movedim(1, -1)
            change = read_at(inverse[:, 1:], ahead, 1.0) - depth
            moved = self.motion(torch.cat((self._look(pyramid, ahead), flow / STRIDE, change), dim=1))
            hidden = self._recur(hidden, torch.cat((given, moved), dim=1))
            flow = flow + STRIDE * self.delta(hidden).float()
            answers.append(window.uv_px + read_at(self._fine(flow, hidden), window.uv_px, 1.0).movedim(1, -1))
        return answers, self._rigid(window, place, flow, hidden, answers[-1])

    def follow(self, window: PointWindow) -> tuple[Float[Tensor, "B S N 2"], Float[Tensor, "B S N"]]:
        """In two frames; all are said to be seen."""
        _, last = self(window)
        uv_px = torch.stack((window.uv_px, last), dim=1)
        return uv_px, torch.ones_like(uv_px[..., 0])

    def losses(self, window: PointWindow, truth: PointTruth) -> dict[str, Float[Tensor, ""]]:
        """L1 in pixels, of every step's flow and of the rigid motion."""
        answers, rigid = self(window)
        known, target = truth.known[:, 1], truth.uv_px[:, 1]
        shares = [_DISCOUNT ** (len(answers) - 1 - i) for i in range(len(answers))]
        each = [masked_mean((uv - target).abs().sum(-1), known) for uv in answers]
        return {
            "flow": torch.stack([share * loss for share, loss in zip(shares, each, strict=True)]).sum(),
            "rigid": masked_mean((rigid - target).abs().sum(-1), known),
        }

    def _pyramid(self, maps: Float[Tensor, "B 2 C h w"]) -> list[Tensor]:
        first, second = maps.unbind(1)
        pairs = torch.einsum("bcij,bckl->bijkl", first, second) / self.config.width**0.5
        levels = [pairs.flatten(0, 2).unsqueeze(1)]
        for _ in range(self.config.levels - 1):
            levels.append(F.avg_pool2d(levels[-1], 2))
        return levels

    def _look(self, pyramid: list[Tensor], ahead_px: Float[Tensor, "B h w 2"]) -> Float[Tensor, "B R h w"]:
        around, at = square(self.config.radius, ahead_px.device), ahead_px.flatten(0, 2)[:, None]
        read = [read_at(p, at + around * STRIDE * 2**i, STRIDE * 2.0**i)[:, 0] for i, p in enumerate(pyramid)]
        return torch.cat(read, dim=-1).unflatten(0, ahead_px.shape[:3]).movedim(-1, 1)

    def _recur(self, hidden: Float[Tensor, "B C h w"], x: Float[Tensor, "B D h w"]) -> Float[Tensor, "B C h w"]:
        keep, reset = self.gates(torch.cat((hidden, x), dim=1)).sigmoid().chunk(2, dim=1)
        new = self.candidate(torch.cat((reset * hidden, x), dim=1)).tanh()
        return ((1 - keep) * hidden + keep * new).float()

    def _fine(self, flow: Float[Tensor, "B 2 h w"], hidden: Float[Tensor, "B C h w"]) -> Float[Tensor, "B 2 H W"]:
        """Flow of every pixel, a mean of nine tokens around it, as the network weighs them."""
        b, _, h, w = flow.shape
        weight = self.mask(hidden).float().view(b, 1, 9, STRIDE, STRIDE, h, w).softmax(dim=2)
        around = F.unfold(F.pad(flow, (1, 1, 1, 1), mode="replicate"), 3).view(b, 2, 9, 1, 1, h, w)
        return (weight * around).sum(dim=2).permute(0, 1, 4, 2, 5, 3).reshape(b, 2, h * STRIDE, w * STRIDE)

    def _rigid(
        self,
        window: PointWindow,
        place: Float[Tensor, "B h w 2"],
        flow: Float[Tensor, "B 2 h w"],
        hidden: Float[Tensor, "B C h w"],
        plain: Float[Tensor, "B N 2"],
    ) -> Float[Tensor, "B N 2"]:
        """Where the bodies of points take them; by flow alone where a point or all around it has no depth."""
        bodies = self.bodies(hidden).float()
        own = read_at(bodies[:, 1:], window.uv_px, STRIDE)
        alike = (-(bodies[:, 1:].flatten(2).unsqueeze(2) - own.unsqueeze(-1)).square().sum(1)).exp()
        start, end = place.flatten(1, 2), place.flatten(1, 2) + flow.flatten(2).mT
        depth_m = [depth_at(window.depth_m[:, i], uv) for i, uv in enumerate((start, end))]
        seen = (depth_m[0] > 0) & (depth_m[1] > 0)
        weight = alike * (bodies[:, 0].flatten(1).sigmoid() * seen)[:, None]
        from_, to = (_lifted(uv, d, window.intrinsics) for uv, d in zip((start, end), depth_m, strict=True))
        own_m = depth_at(window.depth_m[:, 0], window.uv_px)
        with torch.autocast(weight.device.type, enabled=False):
            moved = _move(_lifted(window.uv_px, own_m, window.intrinsics), from_, to, weight)
        lens = window.intrinsics[:, None]
        uv = moved[..., :2] / moved[..., 2:].clamp(min=0.05) * lens[..., :2] + lens[..., 2:]
        good = (own_m > 0) & (weight.sum(-1) > 1e-3) & (moved[..., 2] > 0.05)
        return torch.where(good[..., None], uv, plain)


def _places(maps: Float[Tensor, "B S C h w"]) -> Float[Tensor, "B h w 2"]:
    """The pixel in the middle of every token."""
    b, *_, h, w = maps.shape
    x, y = (STRIDE * (torch.arange(n, device=maps.device) + 0.5) for n in (w, h))
    return mesh(x, y).expand(b, -1, -1, -1)


def _lifted(
    uv_px: Float[Tensor, "B N 2"], depth_m: Float[Tensor, "B N"], intrinsics: Float[Tensor, "B 4"]
) -> Float[Tensor, "B N 3"]:
    ray = (uv_px - intrinsics[:, None, 2:]) / intrinsics[:, None, :2]
    return torch.cat((ray, torch.ones_like(ray[..., :1])), dim=-1) * depth_m[..., None]


def _move(
    point: Float[Tensor, "B N 3"],
    start: Float[Tensor, "B M 3"],
    end: Float[Tensor, "B M 3"],
    weight: Float[Tensor, "B N M"],
) -> Float[Tensor, "B N 3"]:
    """Points moved as rigidly as weighted pairs move: two steps of Gauss-Newton from rest, one body a point."""
    share = weight / weight.sum(-1, keepdim=True).clamp(min=1e-6)
    middle = share @ start
    arms = start[:, None] - middle[:, :, None]
    arm, rest = point - middle, end[:, None] - middle[:, :, None]
    eye = torch.eye(3, device=point.device)
    turn, shift = eye.expand(*point.shape[:2], 3, 3), torch.zeros_like(point)
    for _ in range(2):
        now = arms @ turn.mT
        residual = rest - now - shift[:, :, None]
        moment = (share[..., None] * torch.linalg.cross(now, residual)).sum(2)
        square_, outer = now.square().sum(-1), now.unsqueeze(-1) * now.unsqueeze(-2)
        inertia = (share[..., None, None] * (square_[..., None, None] * eye - outer)).sum(2)
        mean = (share[..., None] * residual).sum(2)
        damping = 1e-4 + 0.01 * inertia.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
        angle = torch.linalg.solve(inertia + damping * eye, moment)
        turn, shift = _rotation(angle) @ turn, shift + mean
    return middle + (turn @ arm[..., None])[..., 0] + shift


def _rotation(angle: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3 3"]:
    """Of rotation vectors, radians."""
    x, y, z = angle.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3)))
