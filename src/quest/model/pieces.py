"""Pieces of a frame that stand out of planes, as candidates for handles and knobs, and the head that ranks them.

Fronts of furniture and appliances are planes. A handle before one is a piece of the image of its own, whose middle,
length and height are measured in depth alone, not guessed, whatever it looks like.

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
from scipy import ndimage
from torch import Tensor, nn

from quest.geometry import lift_depth
from quest.model.config import NetworkConfig
from quest.model.observation import FrameBatch
from quest.types import GRIPS, LABELS, Camera

MEASURES = (
    "pixels", "length", "width", "thinness", "height", "middle_height", "ring", "behind", "before", "plane_px",
    "facing", "upward", "spread", "fill", "front_length", "front_width", "of_length", "of_width", "edge_along",
    "edge_across",
)  # fmt: skip
"""What is measured of each piece: pixels of it and of its plane as logarithms, lengths along the plane in units of the
reference frame and as shares of the front's, heights before the plane, shares of the pixels around it that are on the
plane, behind it, or farther before it than a handle, which way the plane looks, and how noisy its depth is."""

_TOLERANCE = 0.006
"""What is nearer to a plane is in it, units of the reference frame, as all lengths here."""
_LOW = 0.008
_HIGH = 0.12
"""What is between these before a plane stands out of it."""
_PLANES = 14
_TRIES = 300
_SPREADS = 3.0
"""Where depth is noisy, what stands out is so many standard deviations before the plane."""
_NEAR_PX = 10
_SAMPLE = 1500
_LEAST_PLANE_PX = 150
_LEAST_LEFT_PX = 300
_LEAST_PX = 3
_MOST_PX = 5000
_LEAST_RING = 0.3
_EIGHT = np.ones((3, 3), dtype=bool)


@dataclass(frozen=True)
class Plane:
    """A plane that many pixels lie in."""

    normal: Float[np.ndarray, "3"]
    """Towards the camera."""
    middle: Float[np.ndarray, "3"]
    """A point of it."""
    spread: float = 0.0
    """How far what lies in it is off it, as a standard deviation."""

    @property
    def low(self) -> float:
        """What is higher stands out."""
        return max(_LOW, _SPREADS * self.spread)


@dataclass(frozen=True)
class Protrusion:
    """A piece of the image that stands out of a plane."""

    uv_px: tuple[float, float]
    """The pixel of it that is nearest to its middle, (x, y)."""
    rows: Int[np.ndarray, " N"]
    """Of its pixels."""
    columns: Int[np.ndarray, " N"]
    """Of its pixels."""
    measures: Float[np.ndarray, " G"]
    """See :data:`MEASURES`."""


def find_protrusions(image: Float[np.ndarray, "H W 3"]) -> list[Protrusion]:
    """All pieces of an image that stand out of a plane around them; the same image gives the same pieces.

    Args:
        image: what every pixel shows, camera axes, in units of the reference frame; 0 where it is not known.
    """
    known = image[..., 2] > 0
    pieces: list[Protrusion] = []
    for plane in _planes(image, known):
        height = (image - plane.middle) @ plane.normal
        height[~known] = -np.inf
        pieces += _before(image, height, plane)
    return pieces


def _planes(image: Float[np.ndarray, "H W 3"], known: Bool[np.ndarray, "H W"]) -> list[Plane]:
    """Planes in which many of the pixels lie that are in none before."""
    rng = np.random.default_rng(0)
    h, w = known.shape
    left, found = known.copy(), []
    for _ in range(_PLANES):
        ys, xs = np.nonzero(left)
        if len(ys) < _LEAST_LEFT_PX:
            break
        pick = rng.integers(len(ys), size=_TRIES)
        a = image[ys[pick], xs[pick]]
        b, c = (
            image[np.clip(ys[pick] + dy, 0, h - 1), np.clip(xs[pick] + dx, 0, w - 1)]
            for dy, dx in rng.integers(-_NEAR_PX, _NEAR_PX + 1, size=(2, 2, _TRIES))
        )
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1)
        usable = (length > 1e-5) & (b[:, 2] > 0) & (c[:, 2] > 0)
        if not usable.any():
            break
        normal, a = normal[usable] / length[usable, None], a[usable]
        some = rng.integers(len(ys), size=min(_SAMPLE, len(ys)))
        sample = image[ys[some], xs[some]]
        best = int((np.abs(sample @ normal.T - (a * normal).sum(axis=1)) < _TOLERANCE).sum(axis=0).argmax())
        plane = _refined(Plane(normal[best], a[best]), sample)
        inside = left & (np.abs((image - plane.middle) @ plane.normal) < _TOLERANCE)
        size = np.bincount(_pieces(inside).ravel())[1:]
        if size.max(initial=0) >= _LEAST_PLANE_PX:
            found.append(plane)
        left &= ~inside
    return found


def _refined(plane: Plane, sample: Float[np.ndarray, "N 3"]) -> Plane:
    """The plane of least squares through what is near a plane, its normal towards the camera."""
    normal, middle = plane.normal, plane.middle
    for _ in range(2):
        near = sample[np.abs((sample - middle) @ normal) < _TOLERANCE]
        if len(near) < 10:
            break
        middle = near.mean(axis=0)
        normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
    off = np.abs((sample - middle) @ normal)
    spread = 1.4826 * float(np.median(off[off < 4 * _TOLERANCE])) if (off < 4 * _TOLERANCE).any() else 0.0
    return Plane(-normal if normal @ middle > 0 else normal, middle, spread)


def _before(image: Float[np.ndarray, "H W 3"], height: Float[np.ndarray, "H W"], plane: Plane) -> list[Protrusion]:
    """The pieces that stand out of one plane.

    Args:
        image: as above.
        height: of every pixel before the plane; -inf where it is not known.
        plane: the plane.
    """
    low = plane.low
    on = np.abs(height) <= low
    fronts = _pieces(on)
    plane_px = int(on.sum())
    pieces, found = _pieces((height > low) & (height < _HIGH)), []
    for number, box in enumerate(ndimage.find_objects(pieces), start=1):
        around = tuple(slice(max(side.start - 2, 0), side.stop + 2) for side in box)
        piece = pieces[around] == number
        count = int(piece.sum())
        if not _LEAST_PX <= count <= _MOST_PX:
            continue
        ring = ndimage.binary_dilation(piece, iterations=2) & ~piece
        if on[around][ring].mean() < _LEAST_RING:
            continue
        rows, columns = np.nonzero(piece)
        rows, columns = rows + around[0].start, columns + around[1].start
        points = image[rows, columns]
        weight = np.square(points[:, 2])  # a pixel farther away shows more
        middle = (weight[:, None] * points).sum(axis=0) / weight.sum()
        nearest = int(np.square(points - middle).sum(axis=1).argmin())
        flat = points - middle
        flat = flat - np.outer(flat @ plane.normal, plane.normal)
        axes = np.linalg.svd(flat, full_matrices=False)[2][:2]
        length, width = np.ptp(flat @ axes.T, axis=0)
        front = (image[_largest(fronts, fronts[around][ring & on[around]])] - middle) @ axes.T
        begins, ends = front.min(axis=0), front.max(axis=0)
        size = np.maximum(ends - begins, 1e-3)
        edge = np.minimum(ends, -begins) / size
        gap, stands = height[around][ring], height[rows, columns]
        measures = (
            np.log(count), np.log(length + 0.003), np.log(width + 0.003), np.log((width + 0.003) / (length + 0.003)),
            stands.max(), np.median(stands), on[around][ring].mean(), (gap < -2 * low).mean(), (gap >= _HIGH).mean(),
            np.log(plane_px), -(plane.normal @ middle) / np.linalg.norm(middle), -plane.normal[1], plane.spread,
            count / piece.size, np.log(size[0]), np.log(size[1]), length / size[0], width / size[1], edge[0], edge[1],
        )  # fmt: skip
        at = (float(columns[nearest]) + 0.5, float(rows[nearest]) + 0.5)
        found.append(Protrusion(at, rows, columns, np.array(measures, np.float32)))
    return found


def _pieces(mask: Bool[np.ndarray, "H W"]) -> Int[np.ndarray, "H W"]:
    """Connected pieces of a mask, counted from 1."""
    pieces = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, structure=_EIGHT, output=pieces)
    return pieces


def _largest(pieces: Int[np.ndarray, "H W"], beside: Int[np.ndarray, " N"]) -> Bool[np.ndarray, "H W"]:
    """The piece that has the most of some pixels."""
    return pieces == np.bincount(beside).argmax()


PIECES_APART_PX = 4.0
"""Pieces whose middles are closer are one piece before two planes."""

_ON_PX = 6.0
"""A peak that is closer to a pixel of a piece is on it."""
_AROUND_PX = 11
_INPUTS = len(MEASURES) + len(GRIPS)
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
    """Their measures, then the best score of the map on them for each of GRIPS."""
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
    wanted = scores[[LABELS.index(label) for label in GRIPS]].float()
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
    return torch.isin(label, torch.tensor([LABELS.index(name) for name in GRIPS], device=label.device))


class PieceHead(nn.Module):
    """Log odds that pieces are handles or knobs, and that peaks of the map are what they are taken for."""

    def __init__(self) -> None:
        super().__init__()
        self.mean = nn.Buffer(torch.zeros(_INPUTS))
        self.spread = nn.Buffer(torch.ones(_INPUTS))
        self.mlp = nn.Sequential(nn.Linear(_INPUTS, _HIDDEN), nn.SiLU(), nn.Linear(_HIDDEN, 1 + len(GRIPS)))
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
