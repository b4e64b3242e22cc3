"""From the finder's maps to a list of what can be taken hold of in a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from scipy.special import expit, log_expit
from torch import Tensor

from quest.model.finder import COARSE_PX, FINE_PX, MIDDLE_PX, OPENINGS, PLACES, FinderMaps, FinderNetwork
from quest.model.second_look import SecondLook, SecondLooks
from quest.types import LABELS

LABELS_FOUND = (*LABELS, "hinge")
"""Labels of what is found; hinges are no queries."""

SIDE_PX = 32
"""Sides of what the network sees are multiples of this."""
_LEAST = -4.0
"""Logit below which nothing is a candidate."""
_MOST = 200
_SAME_BOX = 0.5
"""Boxes that share so much of their union are one."""
APART_PX = 12.0
"""Rims, fronts and hinges closer than this in what the network sees are one."""
_ACROSS = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
"""Of each of :data:`quest.model.finder.OPENINGS`, from the middle to the edge across the hinge, half sides."""
GREY = 114
"""Of what the network sees beside the picture."""


@dataclass(frozen=True)
class Panels:
    """Doors and drawers, best first."""

    box_px: Float[np.ndarray, "M 4"]
    """Left, top, right and bottom edges, pixels of the source."""
    kind: Int[np.ndarray, " M"]
    """Index into :data:`quest.model.finder.PANELS`."""
    logit: Float[np.ndarray, " M"]
    """Log odds of being one."""
    opening_p: Float[np.ndarray, "M O"]
    """Probability of each of :data:`quest.model.finder.OPENINGS`."""

    def __len__(self) -> int:
        return len(self.kind)


@dataclass(frozen=True)
class Found:
    """What can be taken hold of, best first."""

    uv_px: Float[np.ndarray, "N 2"]
    """Where, pixels of the source."""
    logit: Float[np.ndarray, " N"]
    """Log odds that there is something to take hold of."""
    label_p: Float[np.ndarray, "N L"]
    """Probability of each of :data:`LABELS_FOUND`, given that there is."""
    lift_p: Float[np.ndarray, " N"]
    """Probability that one takes hold of it to lift the whole thing, not to open a part of it."""
    box_px: Float[np.ndarray, "N 4"]
    """Left, top, right and bottom edges of handles and knobs; NaN of the others."""
    panel: Int[np.ndarray, " N"]
    """The door or drawer that it is on, as an index into ``panels``; -1 for none."""
    panels: Panels
    """Doors and drawers."""

    def __len__(self) -> int:
        return len(self.logit)

    @property
    def p(self) -> Float[np.ndarray, " N"]:
        """Probability that there is something to take hold of."""
        return expit(self.logit)

    @property
    def labels(self) -> tuple[str, ...]:
        """The likeliest label of each."""
        return tuple(LABELS_FOUND[int(i)] for i in self.label_p.argmax(axis=1))

    def select(self, rows: Sequence[int] | Int[np.ndarray, " K"] | Bool[np.ndarray, " N"]) -> Found:
        """Some of them, with all panels."""
        return replace(self, **{f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "panels"})


@dataclass(frozen=True)
class Odds:
    """From the network's logits to log odds of being right."""

    gain: float = 1.0
    """Multiplies the logits of what can be taken hold of ..."""
    bias: float = 0.0
    """... and is added to them."""
    panel_gain: float = 1.0
    """The same of doors and drawers."""
    panel_bias: float = 0.0


def find(network: FinderNetwork, rgb: UInt8[np.ndarray, "H W 3"], *, size_px: int, odds: Odds | None = None) -> Found:
    """What can be taken hold of in a picture.

    Args:
        network: in evaluation mode.
        rgb: the picture.
        size_px: longer side of what the network sees.
        odds: of what it says; by default its own.
    """
    height, width = rgb.shape[:2]
    device = next(network.parameters()).device
    canvas, inside = placed(rgb, size_px)
    with torch.inference_mode():
        maps = network(torch.from_numpy(canvas).to(device).permute(2, 0, 1)[None] / 255)
        scale = np.array([inside[1] / width, inside[0] / height])
        return read_off(maps, network.second, scale=scale, size=(width, height), odds=odds or Odds())


def placed(rgb: UInt8[np.ndarray, "H W 3"], size_px: int) -> tuple[UInt8[np.ndarray, "h w 3"], tuple[int, int]]:
    """A picture as the network sees it: in the upper left corner of a grey one with sides in whole steps.

    Args:
        rgb: the picture.
        size_px: its longer side there.

    Returns:
        What the network sees, and how many of its rows and columns the picture takes.
    """
    height, width = rgb.shape[:2]
    scale = size_px / max(height, width)
    rows, columns = max(1, round(height * scale)), max(1, round(width * scale))
    how = cv2.INTER_AREA if columns < width else cv2.INTER_LINEAR
    canvas = np.full((-(-rows // SIDE_PX) * SIDE_PX, -(-columns // SIDE_PX) * SIDE_PX, 3), GREY, np.uint8)
    canvas[:rows, :columns] = cv2.resize(rgb, (columns, rows), interpolation=how)
    return canvas, (rows, columns)


def read_off(
    maps: FinderMaps, second: SecondLooks, *, scale: Float[np.ndarray, "2"], size: tuple[int, int], odds: Odds
) -> Found:
    """What the maps of one picture (B = 1) show, and doors and drawers without a handle or knob.

    Args:
        maps: of the network.
        second: the network's second looks.
        scale: pixels of what the network saw per pixel of the source, along x and y.
        size: width and height of the source.
        odds: of the maps' logits.
    """
    two = np.tile(scale, 2)
    end = np.array(size, np.float64)
    panels = _panels(maps, second.panel, two, np.tile(end, 2), odds)
    levels = (
        _level(maps.place[0], maps.extent[0], FINE_PX),
        _level(maps.longer, maps.longer_extent[0], MIDDLE_PX),
        _level(maps.longest, maps.longest_extent[0], COARSE_PX),
    )
    uv, box, place, logit = (np.concatenate(parts) for parts in zip(*levels, strict=True))
    order = np.argsort(-logit, kind="stable")
    uv, box, place, logit = uv[order], box[order], place[order], logit[order]
    # The inner half of a box may lie outside what the network saw.
    column, row = np.clip((uv / FINE_PX).astype(int), 0, np.array(maps.knob.shape[:0:-1]) - 1).T
    knob, lift = (m[0].sigmoid().double().cpu().numpy()[row, column] for m in (maps.knob, maps.lift))
    label_p = np.zeros((len(logit), len(LABELS_FOUND)))
    for k, name in enumerate(PLACES):
        own = place == k
        if name == "grip":
            label_p[own, LABELS_FOUND.index("handle")], label_p[own, LABELS_FOUND.index("knob")] = (
                (1 - knob)[own], knob[own],
            )  # fmt: skip
        else:
            label_p[own, LABELS_FOUND.index(name)] = 1
    keep = _apart(uv, box, place)
    box[keep] = _looked_at_again(box[keep], maps, second.grip)
    uv = _within_grip(uv, box)
    uv, box = np.clip(uv[keep] / scale, 0, end), np.clip(box[keep] / two, 0, np.tile(end, 2))
    logit = odds.gain * logit[keep] + odds.bias
    seen = Found(uv, logit, label_p[keep], lift[keep], box, _carrier(uv, panels), panels)
    return _with(seen, _without_grip(seen), APART_PX / scale)


def _without_grip(found: Found) -> Found:
    """Doors and drawers that carry no grip: the front of what slides, else the middle of the edge across the hinge.

    One is where its panel is one, no grip lies in it, and no likelier panel takes its place.
    """
    panels, grip = found.panels, ~np.isnan(found.box_px[:, 0])
    low, high = panels.box_px[:, :2], panels.box_px[:, 2:]
    holds = (_inside(found.uv_px, panels) & grip[:, None]).T
    shared_px = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    taken = shared_px.clip(0).prod(axis=-1) / (high - low).prod(axis=1).clip(1)[:, None]
    likelier = np.tri(len(panels), k=-1, dtype=bool)
    opening = panels.opening_p.argmax(axis=1)
    log_p = log_expit(panels.logit) + np.log(panels.opening_p[np.arange(len(panels)), opening])
    log_p += np.where(holds, log_expit(-found.logit), 0.0).sum(axis=1)
    log_p += np.where(likelier, np.log1p(-expit(panels.logit) * taken), 0.0).sum(axis=1)
    middle, slides = (low + high) / 2, opening == OPENINGS.index("slides")
    label_p = np.eye(len(LABELS_FOUND))[np.where(slides, LABELS_FOUND.index("front"), LABELS_FOUND.index("rim"))]
    none = np.full((len(panels), 4), np.nan)
    uv_px = np.where(slides[:, None], middle, middle + _ACROSS[opening] * (high - middle))
    logit = log_p - np.log(-np.expm1(log_p))
    free = Found(uv_px, logit, label_p, np.zeros(len(panels)), none, np.arange(len(panels)), panels)
    return free.select(logit > _LEAST)


def _with(found: Found, more: Found, apart_px: Float[np.ndarray, "2"]) -> Found:
    """With others that are not so near what is found of their label already, best first."""
    same = found.label_p.argmax(axis=1) == more.label_p.argmax(axis=1)[:, None]
    near = (((found.uv_px - more.uv_px[:, None]) / apart_px) ** 2).sum(axis=-1) < 1
    more = more.select(~(same & near).any(axis=1))
    order = np.argsort(-np.concatenate([found.logit, more.logit]), kind="stable")
    names = [f.name for f in fields(found) if f.name != "panels"]
    return replace(found, **{n: np.concatenate([getattr(found, n), getattr(more, n)])[order] for n in names})


def _level(
    logits: Float[Tensor, "P h w"], extent: Float[Tensor, "4 h w"], stride: int
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 4"], Int[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Point, box (NaN of what is no grip), place and logit of the candidates of a level; its first place is a grip."""
    cell, place, logit = _highest(logits, around=1)
    uv = (cell + _within(logits, place, cell)) * stride
    box = _boxes(extent, cell, stride)
    box[place != PLACES.index("grip")] = np.nan
    return _within_grip(uv, box), box, place, logit


def _within_grip(uv: Float[np.ndarray, "N 2"], box: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 2"]:
    """Points on the inner half of their boxes, where there are boxes, because a bar may be thinner than a cell."""
    quarter = (box[:, 2:] - box[:, :2]) / 4
    return np.where(np.isnan(box[:, :1]), uv, np.clip(uv, box[:, :2] + quarter, box[:, 2:] - quarter))


def _looked_at_again(box: Float[np.ndarray, "N 4"], maps: FinderMaps, second: SecondLook) -> Float[np.ndarray, "N 4"]:
    """Boxes after a second look, edges in order; NaN where there was none."""
    box, grip = box.copy(), ~np.isnan(box[:, 0])
    if not grip.any():
        return box
    levels = maps.features, maps.deep_features
    first = torch.from_numpy(box[grip]).to(maps.features)
    edges = second(levels, first, torch.zeros(len(first), dtype=torch.long, device=first.device))
    edges = edges.detach().double().cpu().numpy().reshape(-1, 2, 2)
    box[grip] = np.concatenate((edges.min(axis=1), edges.max(axis=1)), axis=1)
    return box


def _highest(
    logits: Float[Tensor, "P h w"], *, around: int
) -> tuple[Int[np.ndarray, "N 2"], Int[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Column and row, channel and logit of cells that nothing so many cells around them is above, best first."""
    highest = (logits == F.max_pool2d(logits[None], 2 * around + 1, 1, around)[0]) & (logits > _LEAST)
    channel, row, column = torch.nonzero(highest, as_tuple=True)
    value = logits[channel, row, column]
    order = value.argsort(descending=True, stable=True)[:_MOST]
    cell = torch.stack((column, row), dim=-1)[order]
    return cell.cpu().numpy(), channel[order].cpu().numpy(), value[order].double().cpu().numpy()


def _within(
    logits: Float[Tensor, "P h w"], channel: Int[np.ndarray, " N"], cell: Int[np.ndarray, "N 2"]
) -> Float[np.ndarray, "N 2"]:
    """Where in its cell a peak is: the mean of the 3 x 3 cells around it by their probability, in cells."""
    padded = F.pad(logits, (1, 1, 1, 1), value=-torch.inf).sigmoid().double().cpu().numpy()
    step = np.arange(3)
    around = padded[channel[:, None, None], cell[:, 1, None, None] + step[:, None], cell[:, 0, None, None] + step]
    weight = around / around.sum(axis=(1, 2), keepdims=True)
    return np.stack((weight.sum(axis=1) @ (step - 0.5), weight.sum(axis=2) @ (step - 0.5)), axis=-1)


def _boxes(extent: Float[Tensor, "4 h w"], cell: Int[np.ndarray, "N 2"], stride: int) -> Float[np.ndarray, "N 4"]:
    """Edges around cells, pixels of what the network saw."""
    out = extent[:, torch.from_numpy(cell[:, 1]), torch.from_numpy(cell[:, 0])].T.double().cpu().numpy()
    centre = (cell + 0.5) * stride
    return np.concatenate((centre - out[:, :2], centre + out[:, 2:]), axis=1)


def _panels(
    maps: FinderMaps, second: SecondLook, scale: Float[np.ndarray, "4"], end: Float[np.ndarray, "4"], odds: Odds
) -> Panels:
    """Doors and drawers; cells that answer for one, but with other edges, are told to be one by the second look."""
    cell, kind, logit = _highest(maps.panel[0], around=0)
    box = _boxes(maps.panel_extent[0], cell, COARSE_PX)
    keep = _different(box)
    box[keep] = _looked_at_again(box[keep], maps, second)
    keep = keep[_different(box[keep])]
    opening = maps.opening[0].softmax(dim=0).double().cpu().numpy()[:, cell[keep, 1], cell[keep, 0]].T
    logit = odds.panel_gain * logit[keep] + odds.panel_bias
    return Panels(np.clip(box[keep] / scale, 0, end), kind[keep], logit, opening)


def _different(box: Float[np.ndarray, "N 4"]) -> Int[np.ndarray, " M"]:
    """Of boxes, best first, those that are not the box of a better one."""
    keep: list[int] = []
    for i in range(len(box)):
        if not keep or shared(box[i], box[keep]).max() < _SAME_BOX:
            keep.append(i)
    return np.array(keep, np.int64)


def _apart(uv: Float[np.ndarray, "N 2"], box: Float[np.ndarray, "N 4"], place: Int[np.ndarray, " N"]) -> list[int]:
    """Of candidates that are one thing the best: grips with a better one's box, other places near a better one."""
    keep: list[int] = []
    for i in range(len(uv)):
        rivals = [j for j in keep if place[j] == place[i]]
        if not rivals:
            keep.append(i)
        elif np.isnan(box[i, 0]):
            if np.linalg.norm(uv[rivals] - uv[i], axis=1).min() >= APART_PX:
                keep.append(i)
        else:
            theirs = box[rivals]
            in_theirs = ((uv[i] >= theirs[:, :2]) & (uv[i] <= theirs[:, 2:])).all(axis=1)
            in_mine = ((uv[rivals] >= box[i, :2]) & (uv[rivals] <= box[i, 2:])).all(axis=1)
            if not (in_theirs | in_mine).any() and shared(box[i], theirs).max() < _SAME_BOX:
                keep.append(i)
    return keep


def shared(box: Float[np.ndarray, "4"], others: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, " N"]:
    """Intersection of a box with others over their union; 0 of boxes without an area."""
    both = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    inner = both.clip(0).prod(axis=1)
    union = (box[2:] - box[:2]).prod() + (others[:, 2:] - others[:, :2]).prod(axis=1) - inner
    return inner / np.maximum(union, np.finfo(float).tiny)


def _inside(uv: Float[np.ndarray, "N 2"], panels: Panels) -> Bool[np.ndarray, "N M"]:
    """Which points lie in which panels."""
    return np.asarray(((uv[:, None] >= panels.box_px[:, :2]) & (uv[:, None] <= panels.box_px[:, 2:])).all(axis=-1))


def _carrier(uv: Float[np.ndarray, "N 2"], panels: Panels) -> Int[np.ndarray, " N"]:
    """The smallest panel around each point that is likelier there than not, -1 for none."""
    box = panels.box_px
    around = _inside(uv, panels) & (panels.logit > 0)
    if not around.any():
        return np.full(len(uv), -1)
    area = np.where(around, (box[:, 2:] - box[:, :2]).prod(axis=1), np.inf)
    return np.where(around.any(axis=1), area.argmin(axis=1), -1)
