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

    def of_depth(self, depth_m: Float32[np.ndarray, "H W"], *, elsewhere: bool) -> str | None:
        """Why the next depth, metres, is not to be used, in words; None if it is.

        Where the colours say that the camera looks ``elsewhere`` at once, nothing is said of units.
        """
        if elsewhere:
            self.depth_m, self.unit = None, 1.0
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
        return f"{self.unit:.3g} times that of before" if abs(np.log(self.unit)) > np.log(_DEEPER) else None


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    one, other = one.ravel() - one.mean(), other.ravel() - other.mean()
    return float(one @ other / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-9))
