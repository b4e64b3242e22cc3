"""Batches of cuts of views, and the maps that the finder should give for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Int8, UInt8
from torch import Tensor

from quest.errors import ConfigError
from quest.model.finder import COARSE_PX, FINE_PX, MIDDLE_PX, PANELS, PLACES
from quest.train.finding.marks import UNKNOWN, Marks
from quest.train.finding.settings import VIEW_PX, FinderSamplerConfig
from quest.train.finding.views import View, draw_view, read_view, read_whole

_CONTEXT_PX = 16
"""Side of what one token of a cut stands for, pixels."""
_LEAST_CELLS = 0.6
"""Standard deviation of the smallest mark in cells of its map ..."""
_SPREAD = 4.0
"""... and of larger ones, as a part of their side."""
_ON = 0.5
"""A cell is a right answer where its mark is at least this high: anywhere on the inner half of a long bar."""
_LONG = {FINE_PX: (0.0, 40.0), MIDDLE_PX: (32.0, 112.0), COARSE_PX: (90.0, np.inf)}
"""Longer sides of the grips that each level finds, pixels of the cut ..."""
_UNSURE = 2.0
"""... and up to which factor beyond them a level may find them as well."""
_ZOOM = (0.67, 1.5)
"""How much larger than the view a cut shows it."""


@dataclass(frozen=True)
class FinderInputs:
    """What the network sees."""

    rgb: UInt8[Tensor, "B 3 S S"]
    """Colours."""
    context: Float[Tensor, "B E r c"] | None
    """What the transformer sees; None where it learns."""

    def to(self, device: torch.device) -> FinderInputs:
        """The same on a device."""
        return FinderInputs(self.rgb.to(device), None if self.context is None else self.context.to(device))


@dataclass(frozen=True)
class FinderTruth:
    """What the maps should be."""

    place: Float[Tensor, "B P h w"]
    """1 on a place, falling off around it."""
    place_share: Float[Tensor, "B P h w"]
    """What each cell counts of its place; the cells of one sum to 1."""
    longer: Float[Tensor, "B 1 m n"]
    """As ``place``, of longer grips."""
    longer_share: Float[Tensor, "B 1 m n"]
    """As ``place_share``, of longer grips."""
    longer_extent: Float[Tensor, "B 4 m n"]
    """Pixels to the edges of the longer grip that a cell belongs to."""
    longest: Float[Tensor, "B 1 H W"]
    """As ``longer``, of the longest."""
    longest_share: Float[Tensor, "B 1 H W"]
    """As ``longer_share``, of the longest."""
    longest_extent: Float[Tensor, "B 4 H W"]
    """As ``longer_extent``, of the longest."""
    panel: Float[Tensor, "B Q H W"]
    """As ``place``, of panels."""
    panel_share: Float[Tensor, "B Q H W"]
    """As ``place_share``, of panels."""
    known: Bool[Tensor, "B C"]
    """Which kinds are labelled in the picture."""
    extent: Float[Tensor, "B 4 h w"]
    """Pixels to the edges of the grip that a cell belongs to."""
    weight: Float[Tensor, "B h w"]
    """What each cell counts of a grip."""
    panel_extent: Float[Tensor, "B 4 H W"]
    """The same of panels."""
    panel_weight: Float[Tensor, "B H W"]
    """The same of panels."""
    knob: Int8[Tensor, "B h w"]
    """Of cells in which a grip is, -1 where not known."""
    lift: Int8[Tensor, "B h w"]
    """Of cells in which a place is, -1 where not known."""
    opening: Int[Tensor, "B H W"]
    """Of cells that belong to a panel, -1 where not known."""

    def to(self, device: torch.device) -> FinderTruth:
        """The same on a device."""
        return FinderTruth(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})


@dataclass(frozen=True)
class _Cut:
    """A cut of a view, everything random about it drawn."""

    path: Path
    seed: int
    """Of what is random about it."""
    aimed: bool
    """Whether a labelled thing is in it."""


@dataclass(frozen=True)
class FinderPlan:
    """The cuts of one batch."""

    cuts: tuple[_Cut, ...]
    size_px: int

    def part(self, rows: slice) -> FinderPlan:
        """Some of them."""
        return FinderPlan(self.cuts[rows], self.size_px)


class FinderSampler:
    """Draws batches of cuts.

    Args:
        pictures: files of labelled pictures: their views or, where the transformer learns, they themselves.
        takes: the same of simulated frames.
        config: how they are drawn.

    Raises:
        ConfigError: there are no views.
    """

    def __init__(self, pictures: Sequence[Path], takes: Sequence[Path], config: FinderSamplerConfig) -> None:
        self.config = config
        self.pictures, self.takes = list(pictures), list(takes)
        if not self.pictures and not self.takes:
            raise ConfigError("finding: expected labelled pictures or takes to learn from, got none")

    def plan(self, rng: np.random.Generator) -> FinderPlan:
        """The cuts of one batch."""
        config, cuts = self.config, []
        share = config.take_share if self.pictures and self.takes else float(not self.pictures)
        for _ in range(config.batch):
            views = self.takes if rng.random() < share else self.pictures
            path = views[int(rng.integers(len(views)))]
            cuts.append(_Cut(path, int(rng.integers(2**31)), bool(rng.random() < config.aimed_share)))
        return FinderPlan(tuple(cuts), config.cut_px)

    def view(self, path: Path, *, seed: int) -> View:
        """The view that is kept in a file, or another one for every seed of the picture that is kept there."""
        if not self.config.learned_blocks:
            return read_view(path)
        return View(*draw_view(*read_whole(path), np.random.default_rng(seed)))

    def load(self, plan: FinderPlan) -> tuple[FinderInputs, FinderTruth]:
        """Read what a plan, or a part of one, names."""
        size = plan.size_px
        seen = [_see(self.view(cut.path, seed=cut.seed), cut, size) for cut in plan.cuts]
        rgb, context, marks = zip(*seen, strict=True)
        maps = [targets(each, size) for each in marks]
        truth = {name: torch.from_numpy(np.stack([m[name] for m in maps])) for name in maps[0]}
        inputs = FinderInputs(torch.stack(rgb), None if context[0] is None else torch.stack(context))
        return inputs, FinderTruth(**truth)


def whole_view(view: View) -> FinderInputs:
    """A view as the network sees it, uncut (B = 1)."""
    rgb = torch.from_numpy(view.rgb).permute(2, 0, 1)
    return FinderInputs(rgb[None], None if view.context is None else torch.from_numpy(view.context).float()[None])


def _see(view: View, cut: _Cut, size: int) -> tuple[Tensor, Tensor | None, Marks]:
    """A part of a view at another scale, perhaps mirrored, in other colours."""
    rng = np.random.default_rng((cut.seed, 1))
    side = min(round(size / np.exp(rng.uniform(*np.log(_ZOOM)))), VIEW_PX)
    corner, mirrored = _corner(view.marks, rng, side, aimed=cut.aimed), bool(rng.random() < 0.5)
    own = view.rgb[corner[1] : corner[1] + side, corner[0] : corner[0] + side]
    how = cv2.INTER_AREA if side > size else cv2.INTER_LINEAR
    rgb = cv2.resize(own[:, ::-1] if mirrored else own, (size, size), interpolation=how).astype(np.float32) / 255
    rgb = rgb * np.exp(rng.normal(0, 0.1, 3) + rng.normal(0, 0.1)).astype(np.float32)
    if rng.random() < 0.3:
        rgb = rgb + rng.normal(0, rng.uniform(0.01, 0.05), rgb.shape).astype(np.float32)
    if rng.random() < 0.1:
        rgb = np.repeat(rgb.mean(axis=-1, keepdims=True), 3, axis=-1)
    scale = np.full(2, size / side)
    shift = -corner * scale
    if mirrored:
        scale[0], shift[0] = -scale[0], size - shift[0]
    marks = view.marks.warped(scale, shift, (size, size))
    image = torch.from_numpy((255 * rgb.clip(0, 1)).round().astype(np.uint8)).permute(2, 0, 1)
    tokens = None if view.context is None else _context(view.context, corner, side, size, mirrored=mirrored)
    return image, tokens, marks


def _corner(marks: Marks, rng: np.random.Generator, side: int, *, aimed: bool) -> Int[np.ndarray, "2"]:
    """Left and upper edge of a cut."""
    room = VIEW_PX - side
    low, high = np.zeros(2), np.full(2, room)
    if aimed and len(marks):
        at = marks.point_px[rng.integers(len(marks))]
        low, high = (np.clip(at - share * side, 0, room) for share in (0.9, 0.1))
    return np.floor(rng.uniform(low, high + 1e-6)).astype(int)


def _context(
    context: np.ndarray, corner: Int[np.ndarray, "2"], side: int, size: int, *, mirrored: bool
) -> Float[Tensor, "E r c"]:
    """What the transformer sees in a cut: tokens of the view, interpolated."""
    tokens = context.shape[-1]
    # In tokens, as an index of the first one and a place after it.
    step = (np.arange(size // _CONTEXT_PX) + 0.5) * _CONTEXT_PX / size
    place = (corner[:, None] + step * side) * tokens / VIEW_PX - 0.5
    low = np.clip(np.floor(place[:, 0]).astype(int), 0, tokens - 1)
    high = np.clip(np.ceil(place[:, -1]).astype(int), 0, tokens - 1) + 1
    seen = torch.from_numpy(context[:, low[1] : high[1], low[0] : high[0]]).float()
    x, y = ((2 * (place[i] - low[i]) + 1) / (high[i] - low[i]) - 1 for i in (0, 1))
    axes = [torch.from_numpy(axis.copy()).float() for axis in (x[::-1] if mirrored else x, y)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="xy"), dim=-1)
    return F.grid_sample(seen[None], grid[None], padding_mode="border", align_corners=False)[0]


class _Targets:
    """What one level should answer.

    Args:
        kinds: how many kinds of marks it has.
        size: side of the cut, pixels.
        stride: of its cells, pixels.
    """

    def __init__(self, kinds: int, size: int, stride: int) -> None:
        self.cells, self.stride = size // stride, stride
        self.near, self.share = np.zeros((2, kinds, self.cells, self.cells), np.float32)
        self.extent = np.ones((4, self.cells, self.cells), np.float32)
        self.weight = np.zeros((self.cells, self.cells), np.float32)

    def bump(self, box: Float[np.ndarray, "4"], point: Float[np.ndarray, "2"]) -> Float[np.ndarray, "h w"]:
        """1 at a mark's point, falling off with its sides."""
        middle = np.clip(np.round(point / self.stride - 0.5), 0, self.cells - 1)
        spread = np.maximum((box[2:] - box[:2]) / self.stride / _SPREAD, _LEAST_CELLS)
        step = np.arange(self.cells)
        across, down = (np.exp(-np.square(step - middle[k]) / (2 * spread[k] ** 2)) for k in (0, 1))
        return (down[:, None] * across).astype(np.float32)

    def excuse(self, kind: int, bump: Float[np.ndarray, "h w"]) -> None:
        """An answer near a mark is not wrong."""
        self.near[kind] = np.maximum(self.near[kind], np.minimum(bump / _ON, 1))

    def mark(self, kind: int, bump: Float[np.ndarray, "h w"]) -> None:
        """An answer on a mark is right."""
        self.excuse(kind, bump)
        own = bump >= _ON
        self.share[kind][own] = bump[own] / bump[own].sum()

    def outline(self, kind: int, bump: Float[np.ndarray, "h w"], box: Float[np.ndarray, "4"], *, around: bool) -> None:
        """The box of a mark; ``around`` if only cells whose centres it contains can answer."""
        centre = (np.arange(self.cells) + 0.5) * self.stride
        edges = np.stack(np.broadcast_arrays(centre - box[0], (centre - box[1])[:, None], box[2] - centre,
                                             (box[3] - centre)[:, None]))  # fmt: skip
        own = (bump >= _ON) & ((edges > 0).all(axis=0) | (not around))
        self.extent[:, own], self.weight[own] = edges[:, own], self.share[kind][own]


def targets(marks: Marks, size: int) -> dict[str, np.ndarray]:
    """The maps that a cut should give, by their names in :class:`FinderTruth`."""
    grip = PLACES.index("grip")
    fine, panels = _Targets(len(PLACES), size, FINE_PX), _Targets(len(PANELS), size, COARSE_PX)
    long = _Targets(1, size, MIDDLE_PX), _Targets(1, size, COARSE_PX)
    knob, lift = (np.full((fine.cells, fine.cells), UNKNOWN, np.int8) for _ in range(2))
    opening = np.full((panels.cells, panels.cells), UNKNOWN)
    # Larger panels first, so that of two that overlap the smaller one is learned.
    area = (marks.box_px[:, 2:] - marks.box_px[:, :2]).prod(axis=1)
    for i in np.argsort(-area, kind="stable"):
        kind, box = int(marks.kind[i]), marks.box_px[i].clip(0, size)  # as people draw what is cut off
        if kind >= len(PLACES):
            bump = panels.bump(box, (box[:2] + box[2:]) / 2)
            panels.mark(kind - len(PLACES), bump)
            panels.outline(kind - len(PLACES), bump, box, around=True)
            opening[bump >= _ON] = marks.opening[i]
            continue
        point = marks.point_px[i]
        on = fine.bump(box, point) >= _ON
        lift[on] = marks.lift[i]
        if kind != grip:
            fine.mark(kind, fine.bump(box, point))
            continue
        knob[on] = marks.knob[i]
        side = float((box[2:] - box[:2]).max())
        for level in (fine, *long):
            least, most = _LONG[level.stride]
            bump = level.bump(box, point)
            if least < side <= most:
                level.mark(0, bump)
                level.outline(0, bump, box, around=level is fine)
            elif least / _UNSURE < side <= most * _UNSURE:
                level.excuse(0, bump)
    maps = {"place": fine, "longer": long[0], "longest": long[1], "panel": panels}
    return {
        **{name: level.near for name, level in maps.items()},
        **{f"{name}_share": level.share for name, level in maps.items()},
        "extent": fine.extent, "weight": fine.weight, "panel_extent": panels.extent, "panel_weight": panels.weight,
        "longer_extent": long[0].extent, "longest_extent": long[1].extent,
        "knob": knob, "lift": lift, "opening": opening, "known": marks.known,
    }  # fmt: skip
