"""Whether a camera is in good health: pictures and depth that cannot be what it saw next.

A picture in which nothing stands out, that is the one before to the bit where none was so far, or that is turned or
mirrored shows nothing: the filter takes no evidence from it. What else changes at once in a way that no motion explains
is said.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float32, Shaped, UInt8

ELSEWHERE = "another picture at once"
"""Flag of a picture that shows something else."""
_CELL_PX, _SIDE = 16, 40
"""Least width of the cells of the coarse picture, and how many there are along its longer side at most."""
_PLAIN = 6.0
"""Standard deviation of the cells, grey values, below which nothing stands out."""
_CHANGED = 0.4
"""Correlation with the picture before below which it is another one; of 1,600 real pictures none fell below 0.42."""
_EXCHANGED = -0.5
"""Correlation of red less blue with that of before."""
_COLOURFUL = 3.0
_BLUR = 2.5
"""Fall of the logarithm of the sharpness; of 1,600 real pictures none fell by more than 1.8."""
_PART = 0.3
"""Share of the picture that turned black or white at once."""
_DEEPER, _MOST, _ALIKE = 3.0, (0.25, 0.75), 0.2
"""Factor between the depths of two frames, and how far it differs, in its logarithm, in half of the pixels, at which
they are in other units."""
_STILLEST, _STILLEST_DEPTH = 0.97, 0.8
"""Share of pixels as before, in the stillest frame so far, above which pictures have no noise: rendered ones, or video
in which nothing moves. Most real videos, which compress noise away, come to 0.95 and less; real depth to 0.66."""
_RARELY = 0.1
"""Probability of so many repeated pictures in a row, by those so far, below which they are a fault; that of a stiller
picture than any so far, below which noise is known."""
_SHIFTS_PX = 160
"""Width at which colours and depth are compared with those before."""
_OFTEN = 4.0
"""Times by which depth moves further against the colours than is usual, for how far these move, above which it may be
shifted ..."""
_BETTER = 0.03
"""... and is, if its edges correlate so much better with those of the colours once it is moved back. None of
the healthy frames of ``benchmarks/sensor_faults.py`` came to both."""
_USUAL, _KNOWN = 0.4, 20
"""Share of how far the colours move, and a pixel, that is usual before the first, and as how many frames it counts."""
_SHARPEST_GREY, _SHARPEST_DEPTH = 200.0, 0.3
"""Differences across a pixel, grey values and logarithms of depth, above which all edges are alike."""
_TURNED = {(-1, -1): "upside down", (1, -1): "mirrored", (-1, 1): "flipped"}
"""What a setting of the camera can do to its pictures, by the steps of rows and columns."""
_ALIKE_TURNED = 0.75
"""Correlation with the picture before, turned, above which it is that one. Real pictures that are turned come to 0.84
and more, but for one clip to 0.43; of 1,800 that are not, twenty frames later, those that are more like it to 0.65."""


def digest_of(data: np.ndarray) -> int:
    """A number by which a frame is told from the one before."""
    return zlib.crc32(np.ascontiguousarray(data).data)


@dataclass
class Repeats:
    """How often pictures, or depths, came again to the bit."""

    noiseless: float
    """Share of pixels as before above which there is no noise."""
    digest: int | None = None
    """Of the newest."""
    some: Shaped[np.ndarray, "rows columns ..."] | None = None
    """Every eighth of its pixels along each side; None before the first."""
    same: float = 0.0
    """Largest share of pixels that were as before, in those that were not so as a whole."""
    seen: int = 0
    """How many came."""
    runs: int = 0
    """How often they stood still and went on."""
    again: int = 0
    """How many in a row are now as the one before."""

    def are_faults(self, data: Shaped[np.ndarray, "H W ..."], digest: int | None) -> bool:
        """Whether the next one, with its digest, is that before, and this is not what is usual.

        Without noise, what stands still may be a scene that does; whether there is noise takes some pictures to know.
        """
        again, some = digest == self.digest, data[::8, ::8].copy()
        self.runs += self.again > 0 and not again
        self.seen += not again
        if not again and self.some is not None:
            self.same = max(self.same, float((some == self.some).mean()))
        self.digest, self.some, self.again = digest, some, self.again + 1 if again else 0
        # By the rule of succession: that one comes which is stiller than all so far, and so many in a row.
        stiller, repeats = 1 / (self.seen + 2), np.arange(self.again)
        usual = np.prod((self.runs + 1 + repeats) / (self.seen + 2 + repeats))
        return again and self.same < self.noiseless and bool(max(stiller, usual) < _RARELY)


@dataclass
class Alignment:
    """How depth lies on the colours, beside how it lay before; all in pixels of small pictures."""

    grey: Float32[np.ndarray, "h w"] | None = None
    """Edges of the colours with the newest depth that was judged; None before the first."""
    depth: Float32[np.ndarray, "h w"] | None = None
    """Edges of that depth."""
    usual: float = _KNOWN * float(np.log(_USUAL))
    """Sum of the logarithms of how far depth moved against the colours, for how far these moved ..."""
    count: int = _KNOWN
    """... of so many."""
    off: tuple[float, float] | None = None
    """How far depth is shifted, along x and y; None if it is not."""

    def judge(self, grey: UInt8[np.ndarray, "H W"], depth_m: Float32[np.ndarray, "H W"]) -> None:
        """Whether the next depth is shifted, with the luminance that came with it."""
        some = _smaller(depth_m, cv2.INTER_NEAREST)
        if not some.any():
            return
        log_depth = np.log(np.where(some > 0, some, np.median(some[some > 0])))
        depth, colours = _edges(log_depth, _SHARPEST_DEPTH), _edges(_smaller(grey, cv2.INTER_AREA), _SHARPEST_GREY)
        may_be = [] if self.off is None else [self.off]
        if self.grey is not None and self.depth is not None:
            colours_px, depth_px = (np.array(_step(*pair)) for pair in ((self.grey, colours), (self.depth, depth)))
            # Depth that is late, and parallax, are off by a share of the motion.
            moved = float(np.hypot(*(depth_px - colours_px)) / (1 + np.hypot(*colours_px)))
            if moved > _OFTEN * np.exp(self.usual / self.count):
                x, y = (depth_px - colours_px).tolist()
                may_be.append((x, y) if self.off is None else (self.off[0] + x, self.off[1] + y))
            self.usual, self.count = self.usual + float(np.log(max(moved, 0.1 * _USUAL))), self.count + 1
        self.grey, self.depth = colours, depth
        better = {off: _better(depth, colours, off) for off in may_be if np.hypot(*off) > 1}
        self.off = max(better, key=better.__getitem__, default=None)
        if self.off is not None and better[self.off] < _BETTER:
            self.off = None


@dataclass
class Health:
    """What the next picture of a stream is compared with."""

    coarse: Float32[np.ndarray, "h w 3"] | None = None
    """Cells of the newest picture that showed something; None before the first."""
    steps: tuple[int, int] = (1, 1)
    """How it is turned beside the first: steps of rows and columns."""
    sharpness: float = 0.0
    """Logarithm of its Laplacian's variance."""
    depth_m: Float32[np.ndarray, "rows columns"] | None = None
    """Every eighth pixel of the newest depth; None before the first."""
    unit: float = 1.0
    """Its unit, over that of the first."""
    pictures: Repeats = field(default_factory=lambda: Repeats(_STILLEST))
    depths: Repeats = field(default_factory=lambda: Repeats(_STILLEST_DEPTH))
    alignment: Alignment = field(default_factory=Alignment)

    def of_picture(self, rgb: UInt8[np.ndarray, "H W 3"], digest: int | None) -> tuple[tuple[str, ...], bool]:
        """What is wrong with the next picture, in words, and whether it shows nothing."""
        height, width = rgb.shape[:2]
        cell_px = max(_CELL_PX, max(width, height) / _SIDE)
        cells = np.maximum(np.rint(np.array([width, height]) / cell_px), 2).astype(int)
        coarse = cv2.resize(rgb, cells.tolist(), interpolation=cv2.INTER_AREA).astype(np.float32)
        if self.pictures.are_faults(rgb, digest) and self.coarse is not None:
            return ("frozen: the picture before, to the bit",), True
        if coarse.std() < _PLAIN and self.coarse is not None:
            return ("covered: nothing stands out in the picture",), True
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        sharpness = float(np.log(cv2.Laplacian(grey, cv2.CV_32F).var() + 0.5))
        flags = () if self.coarse is None else tuple(self._changes(self.coarse, coarse))
        if self.coarse is not None and sharpness < self.sharpness - _BLUR:
            flags += ("out of focus at once",)
        self.coarse, self.sharpness = coarse, sharpness
        turned = _TURNED.get(self.steps)
        return (flags, False) if turned is None else ((*flags, f"turned: the picture is {turned}"), True)

    def _changes(self, before: Float32[np.ndarray, "h w 3"], now: Float32[np.ndarray, "h w 3"]) -> list[str]:
        """What no motion explains between two coarse pictures, in words."""
        found = []
        turned = {steps: _correlation(before[:: steps[0], :: steps[1]], now) for steps in _TURNED}
        steps, alike = max(turned, key=turned.__getitem__), _correlation(before, now)
        if turned[steps] > max(alike, _ALIKE_TURNED):
            self.steps = (self.steps[0] * steps[0], self.steps[1] * steps[1])
        elif alike < _CHANGED:
            self.steps = (1, 1)
            found.append(ELSEWHERE)
        red, redder = (each[..., 0] - each[..., 2] for each in (before, now))
        if min(red.std(), redder.std()) > _COLOURFUL and _correlation(red, redder) < _EXCHANGED:
            found.append("red and blue exchanged at once")
        for word, lost in (("black", [each.max(axis=-1) < 2 for each in (before, now)]),
                           ("white", [each.min(axis=-1) > 253 for each in (before, now)])):  # fmt: skip
            if lost[1].mean() - lost[0].mean() > _PART:
                found.append(f"part of the picture {word} at once")
        return found

    def of_depth(
        self, depth_m: Float32[np.ndarray, "H W"], grey: UInt8[np.ndarray, "H W"], flags: tuple[str, ...]
    ) -> str | None:
        """Why the next depth, metres, is not to be used, in words; None if it is.

        Where the colours say that the camera looks elsewhere at once, nothing is said of units and shifts.

        Args:
            depth_m: the depth.
            grey: luminance of the picture with it.
            flags: what is wrong with that picture.
        """
        if ELSEWHERE in flags:
            self.depth_m, self.unit, self.alignment = None, 1.0, Alignment()
        if self.depths.are_faults(depth_m, digest_of(depth_m)):
            return "the depth before, to the bit"
        some, before = depth_m[::8, ::8].copy(), self.depth_m
        if not some.any():
            return None
        if before is not None:
            if np.ptp(some[some > 0]) == 0 < np.ptp(before[before > 0]):
                return f"everywhere {some.max():.3g} m"
            both = (some > 0) & (before > 0)
            factor = np.log(some[both] / before[both])
            # What moves, or another place, changes every pixel by a factor of its own; another unit all alike.
            if both.any() and abs(np.median(factor)) > np.log(_DEEPER) and np.ptp(np.quantile(factor, _MOST)) < _ALIKE:
                self.unit *= float(np.exp(np.median(factor)))
        self.depth_m = some
        if not flags and not self.depths.again:
            self.alignment.judge(grey, depth_m)
        if abs(np.log(self.unit)) > np.log(_DEEPER):
            return f"{self.unit:.3g} times that of before"
        if self.alignment.off is not None:
            x, y = np.rint(max(1.0, grey.shape[1] / _SHIFTS_PX) * np.array(self.alignment.off))
            return f"shifted by ({x:.0f}, {y:.0f}) pixels against the colours"
        return None


def _smaller(data: Shaped[np.ndarray, "H W"], how: int) -> Shaped[np.ndarray, "h w"]:
    """A picture or depth of the width at which both are compared."""
    width = min(_SHIFTS_PX, data.shape[1])
    return cv2.resize(data, (width, max(1, round(width / data.shape[1] * data.shape[0]))), interpolation=how)


def _edges(data: Shaped[np.ndarray, "h w"], sharpest: float) -> Float32[np.ndarray, "h w"]:
    """Sizes of the gradients, up to a limit."""
    along = [cv2.Sobel(data, cv2.CV_32F, dx, 1 - dx) for dx in (1, 0)]
    return np.minimum(np.hypot(*along), np.float32(sharpest))


def _step(before: Float32[np.ndarray, "h w"], now: Float32[np.ndarray, "h w"]) -> tuple[float, float]:
    """By how much the second of two pictures is shifted, as a whole, along x and y."""
    window = cv2.createHanningWindow(now.shape[::-1], cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(before - before.mean(), now - now.mean(), window)
    return x, y


def _better(depth: Float32[np.ndarray, "h w"], grey: Float32[np.ndarray, "h w"], off: tuple[float, float]) -> float:
    """How much more alike edges of depth and colours are, as a correlation, if the depth is moved back."""
    back = cv2.warpAffine(depth, np.array([[1, 0, -off[0]], [0, 1, -off[1]]], np.float32), depth.shape[::-1])
    rim = int(np.ceil(np.abs(off).max())) + 1
    if 4 * rim > min(depth.shape):
        return 0.0
    inner = np.s_[rim:-rim, rim:-rim]
    return _correlation(back[inner], grey[inner]) - _correlation(depth[inner], grey[inner])


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    one, other = one.ravel() - one.mean(), other.ravel() - other.mean()
    return float(one @ other / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-9))
