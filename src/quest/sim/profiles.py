"""How one joint gets from closed to open or back: shares of its opening at every frame.

A person moves along minimum-jerk segments, with stops and partial returns. A robot moves at constant speed between
ramps (a trapezoidal profile), waits, and lets go and grasps again, by which it gives back a little. What creeps moves
slowly all the way at nearly constant speed, and sticks and slips.

Reference: Flash and Hogan (1985), The coordination of arm movements, equation for the minimum-jerk trajectory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import Float

ProfileKind = Literal["human", "robot", "creep"]
FRAMES_PER_S = 30.0
PROFILES: tuple[ProfileKind, ...] = ("human", "robot", "creep")

_AMPLITUDE = (0.6, 1.0)
_CREEP_AMPLITUDE = (0.85, 1.0)
_RAMP = (0.1, 0.3)  # of a segment's time, at each end
_STICK_FRAMES = (3, 8)
_SLIP_FRAMES = (3, 5)
_BETWEEN_STICKS = (6, 24)
_WAVER = 0.15


def minimum_jerk(share: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Progress in [0, 1] at shares of the duration in [0, 1]; velocity and acceleration vanish at both ends."""
    return share**3 * (10 - 15 * share + 6 * share**2)


def trapezoid(share: Float[np.ndarray, " N"], ramp: float) -> Float[np.ndarray, " N"]:
    """Progress in [0, 1]: constant speed between ramps of constant acceleration that take a share ``ramp`` each."""
    speed = 1 / (1 - ramp)
    up, down = np.minimum(share, ramp), np.maximum(share - (1 - ramp), 0.0)
    return speed * (up**2 / (2 * ramp) + (share - up) - down**2 / (2 * ramp))


def joint_profile(frames: int, rng: np.random.Generator) -> Float[np.ndarray, " N"]:
    """How far a person has opened a joint at each of its frames; starts near 0, reaches 0.6 to 1 of its opening.

    Three scripts are drawn from: open; open with a stop on the way; open, return a part, open again.
    """
    top = rng.uniform(*_AMPLITUDE)
    script = rng.choice(3, p=(0.4, 0.3, 0.3))
    if script == 0:
        knots, weights = [0.0, top], [1.0]
    elif script == 1:
        stop = rng.uniform(0.3, 0.7) * top
        knots, weights = [0.0, stop, stop, top], [1.0, rng.uniform(0.15, 0.4), 1.0]
    else:
        back = rng.uniform(0.2, 0.6) * top
        knots, weights = [0.0, top, back, rng.uniform(back, top)], [1.2, 0.8, 0.8]
    return _along(knots, _with_last_stop(weights, rng), frames, minimum_jerk)


def draw_profile(
    kind: ProfileKind, frames: int, rng: np.random.Generator, *, closing_from: float | None = None
) -> Float[np.ndarray, " N"]:
    """How far a joint is open at each of its frames, as a share of its opening, in [0, 1].

    No step from frame to frame is longer than 10 / ``frames``.

    Args:
        kind: who moves it.
        frames: how many.
        rng: what the profile is drawn from.
        closing_from: where it starts if it closes, which it then does completely; None if it opens from closed to 0.6
            or more (``creep``: 0.85 or more).
    """
    if closing_from is None:
        if kind == "human":
            return joint_profile(frames, rng)
        top = rng.uniform(*(_CREEP_AMPLITUDE if kind == "creep" else _AMPLITUDE))
        return top * _way(kind, frames, rng)
    return closing_from * (1 - _way(kind, frames, rng))


def _way(kind: ProfileKind, frames: int, rng: np.random.Generator) -> Float[np.ndarray, " N"]:
    """Progress that ends at 1 and never leaves [0, 1]."""
    if kind == "creep":
        return _creep(frames, rng)
    if kind == "robot":
        return _robot(frames, rng)
    script = rng.choice(3, p=(0.5, 0.3, 0.2))
    if script == 0:
        knots, weights = [0.0, 1.0], [1.0]
    elif script == 1:
        stop = rng.uniform(0.3, 0.7)
        knots, weights = [0.0, stop, stop, 1.0], [1.0, rng.uniform(0.15, 0.4), 1.0]
    else:
        turn = rng.uniform(0.6, 0.95)
        knots, weights = [0.0, turn, rng.uniform(0.2, 0.8) * turn, 1.0], [1.0, 0.8, 1.0]
    return _along(knots, _with_last_stop(weights, rng), frames, minimum_jerk)


def _robot(frames: int, rng: np.random.Generator) -> Float[np.ndarray, " N"]:
    knots, weights = [0.0], []

    def go(to: float) -> None:
        weights.append(abs(to - knots[-1]))  # the same speed everywhere
        knots.append(to)

    for stop in np.sort(rng.uniform(0.15, 0.85, size=int(rng.integers(0, 3)))):
        go(float(stop))
        weights.append(rng.uniform(0.08, 0.25))
        knots.append(knots[-1])
        if rng.random() < 0.35:  # it grasps again, and gives back a little
            go(float(stop) * (1 - rng.uniform(0.05, 0.3)))
            weights.append(rng.uniform(0.05, 0.15))
            knots.append(knots[-1])
    go(1.0)
    ramp = rng.uniform(*_RAMP)
    return _along(knots, _with_last_stop(weights, rng), frames, lambda share: trapezoid(share, ramp))


def _creep(frames: int, rng: np.random.Generator) -> Float[np.ndarray, " N"]:
    """A drive that advances steadily pulls what sticks for a few frames and then slips after it."""
    drive = np.arange(1, frames + 1, dtype=float)
    t = int(rng.integers(*_BETWEEN_STICKS))
    while True:
        stick, slip = (int(rng.integers(low, high + 1)) for low, high in (_STICK_FRAMES, _SLIP_FRAMES))
        if t + stick + slip >= frames:
            break
        drive[t : t + stick] = drive[t - 1]
        caught_up = drive[t + stick + slip - 1]
        drive[t + stick : t + stick + slip] = drive[t - 1] + (caught_up - drive[t - 1]) * minimum_jerk(
            np.arange(1, slip + 1) / slip
        )
        t += stick + slip + int(rng.integers(*_BETWEEN_STICKS))
    time = drive / frames
    # Speed wavers slowly by 15 % about its mean; it starts and stops within a tenth of the time.
    steady = trapezoid(time, 0.1)
    turns = rng.integers(1, 4)
    return np.clip(steady + _WAVER / (2 * np.pi * turns) * np.sin(2 * np.pi * turns * steady), 0.0, 1.0)


def _with_last_stop(weights: list[float], rng: np.random.Generator) -> list[float]:
    """The end of the script may come a little before the end of the share."""
    return [*weights, rng.uniform(0.0, 0.15) * sum(weights)]


def _along(
    knots: list[float],
    weights: list[float],
    frames: int,
    ease: Callable[[np.ndarray], np.ndarray],
) -> Float[np.ndarray, " N"]:
    """From knot to knot in times that go with the weights, and rest at the last."""
    knots = [*knots, knots[-1]]
    ends = np.concatenate(([0.0], np.cumsum(weights) / np.sum(weights)))
    share = np.arange(1, frames + 1) / frames
    segment = np.clip(np.searchsorted(ends, share, side="left") - 1, 0, len(weights) - 1)
    length = np.maximum(ends[segment + 1] - ends[segment], 1e-9)
    progress = ease(np.clip((share - ends[segment]) / length, 0.0, 1.0))
    start, end = np.array(knots)[segment], np.array(knots)[segment + 1]
    return start + (end - start) * progress
