"""The line or circle that most points of a track are near, by least squares without the points that are far from it.

Reference: Black and Rangarajan, On the Unification of Line Processes, Outlier Rejection, and Robust Statistics, IJCV
1996, for the loss of the first round (Cauchy's, of the point's whole distance, so that the answer turns with the
track); Moré, The Levenberg-Marquardt Algorithm, 1978, for the solver, which is MINPACK's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from quest.geometry.vectors import cross, perpendicular
from quest.grounding.prior import JointPrior
from quest.grounding.starts import Starts

_ROBUST_SIGMAS = 2.5
_OUTLIER_SIGMAS = 4.0
_MEDIAN_OF_TWO = 1.1774
"""Median length of a vector of two standard normal numbers."""
_ROUNDS = 3
_ROUGH, _FINE = 1e-3, 1e-5
_MOST_STEPS = 25
_STRAY_SHARE = 0.1
_WEAK_RADIUS_SHARE = 5.0


@dataclass(frozen=True)
class Track:
    """What a curve has to explain."""

    points: Float[np.ndarray, "N 3"]
    """In the order of time."""
    sigma: Float[np.ndarray, " N"]
    """Standard deviation of each per coordinate."""
    extent: float
    """The track's size."""
    prior: JointPrior | None
    """What is believed already."""
    single: Bool[np.ndarray, " N"]
    """Points that were seen once, so that they may be wrong; a mean of several is not."""


@dataclass(frozen=True)
class Curve:
    """A fitted line (P = 4) or circle (P = 6)."""

    axis: Float[np.ndarray, "3"]
    """Unit direction of the line, or of the circle's axis."""
    place: Float[np.ndarray, "3"]
    """A point of the line, or the circle's centre."""
    radius: float
    """Of the circle; 0 for a line."""
    covariance: Float[np.ndarray, "P P"]
    """Of tilt about ``place`` (2) and shift (2) in the basis of ``perpendicular(axis)``; of a circle also radius and
    height."""
    used: Bool[np.ndarray, " N"]
    """Points that are near and not stray."""
    stray: Bool[np.ndarray, " N"]
    """Points that are near by chance, far along the curve from all others."""


@dataclass(frozen=True)
class _Values:
    """Distances across the curve in standard deviations, what the prior adds, and the derivatives of both."""

    off: np.ndarray
    by_off: np.ndarray
    extra: np.ndarray
    by_extra: np.ndarray


_Model = Callable[[np.ndarray], _Values]


def fit_line(track: Track, starts: Starts) -> Curve:
    """The best line near one of some starts."""
    models = [_line(track, *chart) for chart in _charts(starts)]
    best, x = _rough(models, [np.zeros(4)] * len(starts))
    axis, place, basis = _charts(starts)[best]
    along = (track.points - place) @ axis
    x, covariance, used, stray = _fine(models[best], x, lambda _, near: _strays(along, near, track.single))
    now = _unit(axis + basis @ x[:2])
    return Curve(now, place + basis @ x[2:], 0.0, rebased(covariance, basis, now), used, stray)


def fit_circle(track: Track, starts: Starts) -> Curve:
    """The best circle near one of some starts."""
    models = [_circle(track, *chart) for chart in _charts(starts)]
    best, x = _rough(models, [np.array([0.0, 0.0, 0.0, 0.0, radius, 0.0]) for radius in starts.radius])
    axis, place, basis = _charts(starts)[best]

    def strays(x: np.ndarray, near: np.ndarray) -> np.ndarray:
        across = (track.points - place - basis @ x[2:4]) @ perpendicular(_unit(axis + basis @ x[:2]))
        direction = across[:, 0] + 1j * across[:, 1]
        # Cut the circle open opposite to where most points are.
        middle = (direction[near] / np.maximum(np.abs(direction[near]), 1e-12)).sum()
        return _strays(np.angle(direction * np.conj(middle)), near, track.single)

    x, covariance, used, stray = _fine(models[best], x, strays)
    now = _unit(axis + basis @ x[:2])
    # Tilt about the height of the circle instead of the point where the fit began.
    change = np.eye(6)
    change[2:4, :2] = x[5] * np.eye(2)
    covariance = rebased(change @ covariance @ change.T, basis, now)
    return Curve(now, place + basis @ x[2:4] + x[5] * now, float(x[4]), covariance, used, stray)


def _charts(starts: Starts) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Axis, place and basis in which the curves near each start are few numbers near zero."""
    return [(axis, place, perpendicular(axis)) for axis, place in zip(starts.axis, starts.place, strict=True)]


def rebased(
    covariance: Float[np.ndarray, "P P"], basis: Float[np.ndarray, "3 2"], axis: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "P P"]:
    """A covariance whose first two pairs are written in a basis, in the basis of another axis near it."""
    turn = perpendicular(axis).T @ basis
    change = np.eye(len(covariance))
    change[:2, :2] = change[2:4, 2:4] = turn
    return change @ covariance @ change.T


def _rough(models: list[_Model], starts: list[np.ndarray]) -> tuple[int, np.ndarray]:
    """Which start leads to the best robust fit, and that fit; gross errors hardly count."""
    found = [
        _descend(lambda x, model=model: _rows(_cauchy(model(x)), None), start, _ROUGH)
        for model, start in zip(models, starts, strict=True)
    ]
    best = int(np.argmin([cost for _, cost in found]))
    return best, found[best][0]


def _fine(
    model: _Model, x: np.ndarray, strays: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Solution by least squares without outliers, its covariance, which points were used, which were stray.

    Points beyond four sigmas are left out. Where most points are farther off than the noise allows, the noise counts as
    larger.
    """
    values, used, stray, scale = model(x), np.zeros(0, bool), np.zeros(0, bool), 1.0
    for _ in range(_ROUNDS):
        gap = np.linalg.norm(values.off, axis=1)
        scale = max(1.0, float(np.median(gap)) / _MEDIAN_OF_TWO)
        near = gap < _OUTLIER_SIGMAS * scale
        stray = strays(x, near)
        if np.array_equal(near & ~stray, used):
            break
        used = near & ~stray
        x = _descend(lambda x, used=used: _rows(model(x), used), x, _FINE)[0]
        values = model(x)
    slope = _rows(values, used)[1]
    value, vector = np.linalg.eigh(slope.T @ slope)
    return x, scale**2 * (vector / np.maximum(value, 1e-8)) @ vector.T, used, stray


def _strays(along: np.ndarray, near: np.ndarray, single: np.ndarray) -> np.ndarray:
    """Few points at an end of the curve, farther from the others than half of the way that these cover."""
    stray = np.zeros(len(along), bool)
    order = np.flatnonzero(near)
    order = order[np.argsort(along[order], kind="stable")]
    for _ in range(int(_STRAY_SHARE * len(order))):
        way = along[order]
        if single[order[-1]] and way[-1] - way[-2] > (way[-2] - way[0]) / 2:
            stray[order[-1]], order = True, order[:-1]
        elif single[order[0]] and way[1] - way[0] > (way[-1] - way[1]) / 2:
            stray[order[0]], order = True, order[1:]
        else:
            break
    return stray


def _descend(
    rows: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], start: np.ndarray, tolerance: float
) -> tuple[np.ndarray, float]:
    """Where the squares of rows are smallest near a start, and half of their sum."""
    # The solver asks for the residuals and then for their slopes at the same place.
    last: list[tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]] = []

    def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not last or not (last[0][0] == x).all():
            last[:] = [(x.copy(), rows(x))]
        return last[0][1]

    how: dict[str, Any] = {"jac": lambda x: at(x)[1], "method": "lm", "max_nfev": _MOST_STEPS}
    found = least_squares(lambda x: at(x)[0], start, ftol=tolerance, xtol=tolerance, **how)
    return found.x, float(found.cost)


def _rows(values: _Values, used: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    off, by_off = values.off, values.by_off
    if used is not None:
        off, by_off = off * used[:, None], by_off * used[:, None, None]
    return (
        np.concatenate((off.ravel(), values.extra)),
        np.concatenate((by_off.reshape(-1, by_off.shape[-1]), values.by_extra)),
    )


def _cauchy(values: _Values) -> _Values:
    """Distances shrunk such that their squares are Cauchy's loss."""
    off = values.off
    square = np.maximum(np.square(off).sum(axis=1), 1e-9)
    loss = _ROBUST_SIGMAS**2 * np.log1p(square / _ROBUST_SIGMAS**2)
    share = np.sqrt(loss / square)
    by_square = (1 / (1 + square / _ROBUST_SIGMAS**2) - loss / square) / (2 * square * share)
    inward = np.einsum("ni,nip->np", off, values.by_off)
    by_off = share[:, None, None] * values.by_off + 2 * (by_square[:, None] * off)[:, :, None] * inward[:, None]
    return _Values(share[:, None] * off, by_off, values.extra, values.by_extra)


def _line(track: Track, axis: np.ndarray, place: np.ndarray, basis: np.ndarray) -> _Model:
    """Parameters: slopes of the line against an axis (2), and its shift across it (2)."""
    offset = track.points - place
    along, across = offset @ axis, offset @ basis
    n, prior, sigma = len(offset), track.prior, track.sigma[:, None]
    by_off = np.zeros((n, 2, 4))
    by_off[:, 0, 0] = by_off[:, 1, 1] = -along / track.sigma
    by_off[:, 0, 2] = by_off[:, 1, 3] = -1 / track.sigma

    def model(x: np.ndarray) -> _Values:
        off = (across - x[2:] - along[:, None] * x[:2]) / sigma
        if prior is None:
            return _Values(off, by_off, np.zeros(0), np.zeros((0, 4)))
        extra, by_tilt = _tilt(axis, basis, x[:2], prior.prismatic_axis, prior.prismatic_axis_sigma_rad)
        return _Values(off, by_off, extra, np.column_stack((by_tilt, np.zeros((3, 2)))))

    return model


def _circle(track: Track, axis: np.ndarray, place: np.ndarray, basis: np.ndarray) -> _Model:
    """Parameters: slopes of the axis (2), shift across it (2), radius, height of the circle."""
    n, prior, sigma = len(track.points), track.prior, track.sigma[:, None]
    weak = 1 / (_WEAK_RADIUS_SHARE * track.extent)
    radius_only, shift_only = np.eye(6)[4:5], np.eye(6)[2:4]

    def model(x: np.ndarray) -> _Values:
        now, by_slope = _tilted(axis, basis, x[:2])
        offset = track.points - place - basis @ x[2:4]
        height = offset @ now
        outward = offset - height[:, None] * now
        radius = np.sqrt(np.square(outward).sum(1))
        outward = outward / np.maximum(radius, 1e-12)[:, None]
        by_off = np.zeros((n, 2, 6))
        by_off[:, 0, :2] = -height[:, None] * (outward @ by_slope)
        by_off[:, 0, 2:4] = -outward @ basis
        by_off[:, 1, :2] = offset @ by_slope
        by_off[:, 1, 2:4] = -(now @ basis)
        by_off[:, 0, 4] = by_off[:, 1, 5] = -1
        off = np.stack((radius - x[4], height - x[5]), axis=1) / sigma
        by_off /= sigma[:, :, None]
        if prior is None:
            # Without a prior a circle is never much larger than what was seen of it.
            return _Values(off, by_off, x[4:5] * weak, radius_only * weak)
        tilt, by_tilt = _tilt(axis, basis, x[:2], prior.revolute_axis, prior.revolute_axis_sigma_rad)
        shift = (basis.T @ (place - prior.origin) + x[2:4]) / prior.origin_sigma
        by_extra = np.vstack((np.column_stack((by_tilt, np.zeros((3, 4)))), shift_only / prior.origin_sigma))
        return _Values(off, by_off, np.concatenate((tilt, shift)), by_extra)

    return model


def _tilted(axis: np.ndarray, basis: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unit axis that slopes make of an axis, with its derivatives by them."""
    raw = axis + basis @ slopes
    length = float(np.sqrt(raw @ raw))
    now = raw / length
    return now, (basis - now[:, None] * (now @ basis)) / length


def _tilt(
    axis: np.ndarray, basis: np.ndarray, slopes: np.ndarray, expected: np.ndarray, sigma_rad: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sine of the angle to an expected axis, as a vector, with its derivatives by the slopes."""
    now, by_slope = _tilted(axis, basis, slopes)
    return cross(now, expected) / sigma_rad, cross(by_slope.T, expected).T / sigma_rad


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
