"""Where the fit of a line or circle begins: curves through few points of the track, so that outliers spoil only some.

References: Fischler and Bolles, Random Sample Consensus, Communications of the ACM 1981; Kåsa, A Circle Fitting
Procedure and its Error Analysis, IEEE Transactions on Instrumentation and Measurement 1976, for circles through many
points. The samples are a fixed sequence that covers the track evenly: the same track always gives the same joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from quest.geometry.vectors import cross

_TRIPLES = 24
_MOST_SCORED = 96
_MOST_MISFIT = 9.0
_NEAR_SIGMAS = 4.0
_MOST_CIRCLES = 3
_GOLDEN = 1.2207440846057596
"""Root of x^4 = x + 1: its powers make the additive sequence that covers a cube most evenly."""

_PLACES = (np.arange(3) + np.mod(0.5 + np.arange(1, _TRIPLES + 1)[:, None] / _GOLDEN ** np.arange(1, 4), 1.0)) / 3
"""Triples of places in [0, 1), one in each third."""


@dataclass(frozen=True)
class Starts:
    """Lines and circles to begin with."""

    axis: Float[np.ndarray, "S 3"]
    """Unit directions of the lines, or of the circles' axes."""
    place: Float[np.ndarray, "S 3"]
    """A point of each line, or the circles' centres."""
    radius: Float[np.ndarray, " S"]
    """Of the circles; 0 for lines."""

    def __len__(self) -> int:
        return len(self.axis)

    def __getitem__(self, index: slice | list[int] | np.ndarray) -> Starts:
        return Starts(self.axis[index], self.place[index], self.radius[index])

    def off(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "S N"]:
        """Distances of points from each curve."""
        offset = points - self.place[:, None]
        height = np.einsum("snd,sd->sn", offset, self.axis)
        outward = np.sqrt(np.maximum(np.square(offset).sum(-1) - np.square(height), 0))
        radius = self.radius[:, None]
        return np.where(radius > 0, np.hypot(outward - radius, height), outward)

    def best(self, points: Float[np.ndarray, "N 3"], sigma: Float[np.ndarray, " N"], most: int) -> Starts:
        """The curves that most points are near, the best one first."""
        step = -(-len(points) // _MOST_SCORED)
        misfit = np.minimum(np.square(self.off(points[::step]) / sigma[::step]), _MOST_MISFIT).sum(axis=1)
        return self[np.argsort(misfit, kind="stable")[:most]]


_NONE = Starts(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


def join(*starts: Starts) -> Starts:
    """All of them."""
    return Starts(
        np.concatenate([s.axis for s in starts]),
        np.concatenate([s.place for s in starts]),
        np.concatenate([s.radius for s in starts]),
    )


def lines(points: Float[np.ndarray, "N 3"]) -> Starts:
    """Lines through two points of the track, and along its main direction."""
    triple = _triples(points)
    way = triple[:, 2] - triple[:, 0]
    length = np.linalg.norm(way, axis=1)
    keep = length > 1e-12
    through = Starts(way[keep] / length[keep, None], triple[keep].mean(axis=1), np.zeros(int(keep.sum())))
    return join(line_through(points), through)


def line_through(points: Float[np.ndarray, "N 3"]) -> Starts:
    """The line through the median of all points along their main direction."""
    middle = np.median(points, axis=0)
    return Starts(np.linalg.svd(points - middle, full_matrices=False)[2][:1], middle[None], np.zeros(1))


def circles(points: Float[np.ndarray, "N 3"]) -> Starts:
    """Circles through three points of the track, through the medians of its thirds, and through all of it."""
    thirds = np.stack([np.median(part, axis=0) for part in np.array_split(points, 3)])
    triple = np.concatenate((_triples(points), thirds[None]))
    one, other = triple[:, 1] - triple[:, 0], triple[:, 2] - triple[:, 0]
    normal = cross(one, other)
    area, first, second = (np.square(v).sum(1, keepdims=True) for v in (normal, one, other))
    arm = cross(normal, one) * second + cross(other, normal) * first
    keep = (area > 1e-12 * first * second)[:, 0]
    arm, area = arm[keep] / (2 * area[keep]), area[keep]
    through = Starts(normal[keep] / np.sqrt(area), triple[keep, 0] + arm, np.linalg.norm(arm, axis=1))
    return join(through, circle_through(points))


def circle_through(points: Float[np.ndarray, "N 3"]) -> Starts:
    """The circle that is near all points, in their main plane; none if they are in line.

    Three points of a short arc hardly tell on which side its centre is; many points do.
    """
    if len(points) < 3:
        return _NONE
    middle = points.mean(axis=0)
    main = np.linalg.svd(points - middle, full_matrices=False)[2]
    flat = (points - middle) @ main[:2].T
    size = max(float(np.abs(flat).max()), 1e-12)
    system = np.column_stack((flat / size, np.ones(len(flat))))
    solution, _, rank, _ = np.linalg.lstsq(system, np.square(flat / size).sum(axis=1), rcond=1e-9)
    if rank < 3:
        return _NONE
    centre = solution[:2] / 2
    radius = size * np.sqrt(max(solution[2] + centre @ centre, 1e-12))
    return Starts(main[2:3], (middle + size * centre @ main[:2])[None], np.array([radius]))


def start_lines(points: Float[np.ndarray, "N 3"], sigma: Float[np.ndarray, " N"]) -> Starts:
    """The line that most points are near."""
    return lines(points).best(points, sigma, 1)


def start_circles(points: Float[np.ndarray, "N 3"], sigma: Float[np.ndarray, " N"], line: Starts) -> Starts:
    """The circles that most points are near, begun also from what is near a line; the best first, maybe none."""
    found = join(circles(points), circle_through(points[line.off(points)[0] < _NEAR_SIGMAS * sigma]))
    return found.best(points, sigma, _MOST_CIRCLES)


def _triples(points: np.ndarray) -> np.ndarray:
    """Points of the track by three: half of them spread over time, half over the way."""
    n = len(points)
    # Most frames of a track may stand still: three of them tell nothing, three places of the way do.
    way = np.linalg.norm(points - np.median(points[:5], axis=0), axis=1)
    order = np.argsort(way, kind="stable")
    on_way = order[np.minimum(np.searchsorted(way[order], _PLACES * way[order[int(0.9 * (n - 1))]]), n - 1)]
    return points[np.concatenate(((_PLACES * n).astype(int), on_way))]
