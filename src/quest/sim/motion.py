"""Motion scripts: which joint is where at every frame of a take.

Nothing moves in the first :data:`HOLD_FRAMES` frames. Then the chosen joints move one after the other, or overlapping,
``frames_per_joint`` frames each (the hold is part of the first joint's share), and stay where their shares end. How
they move is a :class:`MotionStyle`. Whether moving parts run into each other is not looked at: drawers behind a door
need an order and no overlap.

A person moves along minimum-jerk segments, with stops and partial returns. A robot moves at constant speed between
ramps (a trapezoidal profile), waits, and lets go and grasps again, by which it gives back a little. What creeps moves
slowly all the way at nearly constant speed, and sticks and slips.

Reference: Flash and Hogan (1985), The coordination of arm movements, equation for the minimum-jerk trajectory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from quest.errors import ConfigError
from quest.sim.articulation import Articulation

ProfileKind = Literal["human", "robot", "creep"]
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


def draw_profile(
    kind: ProfileKind, frames: int, rng: np.random.Generator, *, closing_from: float | None = None
) -> Float[np.ndarray, " N"]:
    """How far a joint is open at each of its frames, as a share of its opening, in [0, 1].

    No step from frame to frame is longer than 10 / ``frames``.

    It starts at ``closing_from`` if it closes, which it then does completely; None if it opens from closed to 0.6 or
    more (``creep``: 0.85 or more).
    """
    # Progress that ends at 1 and never leaves [0, 1].
    way = {"human": _person, "robot": _robot, "creep": _creep}[kind]
    if closing_from is not None:
        return closing_from * (1 - way(frames, rng))
    top = rng.uniform(*(_CREEP_AMPLITUDE if kind == "creep" else _AMPLITUDE))
    return _person(frames, rng, opens_to=top) if kind == "human" else top * way(frames, rng)


def _person(frames: int, rng: np.random.Generator, *, opens_to: float | None = None) -> Float[np.ndarray, " N"]:
    """All the way, with a stop on it, or with a return; a person who opens may stay where the return ends."""
    top = 1.0 if opens_to is None else opens_to
    script = rng.choice(3, p=(0.5, 0.3, 0.2) if opens_to is None else (0.4, 0.3, 0.3))
    if script == 0:
        knots, weights = [0.0, top], [1.0]
    elif script == 1:
        stop = rng.uniform(0.3, 0.7) * top
        knots, weights = [0.0, stop, stop, top], [1.0, rng.uniform(0.15, 0.4), 1.0]
    elif opens_to is None:
        turn = rng.uniform(0.6, 0.95)
        knots, weights = [0.0, turn, rng.uniform(0.2, 0.8) * turn, 1.0], [1.0, 0.8, 1.0]
    else:
        back = rng.uniform(0.2, 0.6) * top
        knots, weights = [0.0, top, back, rng.uniform(back, top)], [1.2, 0.8, 0.8]
    return _along(knots, weights, frames, minimum_jerk, rng)


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
    return _along(knots, weights, frames, lambda share: trapezoid(share, ramp), rng)


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


def _along(
    knots: list[float],
    weights: list[float],
    frames: int,
    ease: Callable[[np.ndarray], np.ndarray],
    rng: np.random.Generator,
) -> Float[np.ndarray, " N"]:
    """From knot to knot in times that go with the weights, and rest at the last for a little while or not at all."""
    knots, weights = [*knots, knots[-1]], [*weights, rng.uniform(0.0, 0.15) * sum(weights)]
    ends = np.concatenate(([0.0], np.cumsum(weights) / np.sum(weights)))
    share = np.arange(1, frames + 1) / frames
    segment = np.clip(np.searchsorted(ends, share, side="left") - 1, 0, len(weights) - 1)
    length = np.maximum(ends[segment + 1] - ends[segment], 1e-9)
    progress = ease(np.clip((share - ends[segment]) / length, 0.0, 1.0))
    start, end = np.array(knots)[segment], np.array(knots)[segment + 1]
    return start + (end - start) * progress


HOLD_FRAMES = 8
FRAMES_PER_S = 30.0
_MOVES_AT_LEAST = 3
_LONG_SHARE = (0.7, 1.5)
_PAUSE_OFTEN = 0.3
_PAUSE_S = (0.3, 3.0)


@dataclass(frozen=True)
class MotionStyle:
    """How joints move."""

    kind: Literal["human", "robot", "creep", "mixed"] = "human"
    """``human`` (minimum jerk, stops, returns), ``robot`` (constant speed between ramps, waits, regrasps), ``creep``
    (slowly all the way, sticking and slipping) or ``mixed`` (every movement draws one)."""
    overlap: float = 0.0
    """Part of a joint's share, in [0, 0.9), in which the next one is already on its way. N shares of F frames make a
    take of ``F + (N - 1) round((1 - overlap) F)`` frames, unless a joint has to wait for itself."""
    margin: tuple[int, int] = (0, 0)
    """Frames at the start and at the end of every share in which its joint does not move, after the hold."""
    cycles: int = 1
    """How often the joints are gone through: in the first pass they open in order, in the second they close in the
    opposite order, in the third they open again, and so on."""

    def __post_init__(self) -> None:
        if self.kind not in (*PROFILES, "mixed"):
            raise ConfigError(f"motion: expected one of {', '.join((*PROFILES, 'mixed'))}, got {self.kind!r}")
        if not 0 <= self.overlap < 0.9:
            raise ConfigError(f"motion: expected an overlap from 0 to less than 0.9, got {self.overlap}")
        if min(self.margin) < 0:
            raise ConfigError(f"motion: expected margins of 0 frames or more, got {self.margin}")
        if self.cycles < 1:
            raise ConfigError(f"motion: expected at least 1 cycle, got {self.cycles}")


@dataclass(frozen=True)
class Share:
    """One movement of one joint."""

    joint: int
    start: int
    moves: int
    """First frame at which the joint may be elsewhere than before."""
    stops: int
    """From here on it stays where it is."""
    end: int
    """One past the last frame of the share."""
    opens: bool = True


def motion_script(
    articulation: Articulation,
    moved_joints: tuple[int, ...],
    rng: np.random.Generator,
    *,
    frames_per_joint: int = 60,
    style: MotionStyle = MotionStyle(),
) -> Float[np.ndarray, "T J"]:
    """Joint positions (radians or metres) at every frame of a take.

    ``frames_per_joint`` are the frames that each joint gets, in order; the hold is taken from the first one's.

    Raises:
        ConfigError: ``frames_per_joint`` leaves no time to move.
    """
    shares = share_plan(moved_joints, frames_per_joint=frames_per_joint, style=style)
    return _played(articulation, shares, max((s.end for s in shares), default=0), rng, style)


def share_plan(
    moved_joints: tuple[int, ...], *, frames_per_joint: int = 60, style: MotionStyle = MotionStyle()
) -> list[Share]:
    """When which joint moves in a :func:`motion_script`.

    Raises:
        ConfigError: ``frames_per_joint`` leaves no time to move.
    """
    _check_room(frames_per_joint, style)
    step = round((1 - style.overlap) * frames_per_joint)
    shares: list[Share] = []
    free = dict.fromkeys(moved_joints, 0)
    start = -step
    for cycle in range(style.cycles):
        for joint in moved_joints if cycle % 2 == 0 else moved_joints[::-1]:
            start = max(start + step, free[joint])
            free[joint] = start + frames_per_joint
            shares.append(_share(joint, start, frames_per_joint, style, opens=cycle % 2 == 0))
    return shares


def long_script(
    articulation: Articulation,
    moved_joints: tuple[int, ...],
    rng: np.random.Generator,
    *,
    frames: int,
    frames_per_joint: int = 60,
    style: MotionStyle = MotionStyle(),
) -> Float[np.ndarray, "T J"]:
    """Joint positions at every one of ``frames`` frames: the joints open and close again and again, in random order.

    Every joint gets its turn before any comes again; those that are open close at their turn. Shares are 0.7 to 1.5
    times as long as ``frames_per_joint``, with pauses between some. The script ends wherever it is. The cycles of the
    style do not count.

    Raises:
        ConfigError: there is no joint, or ``frames_per_joint`` or ``frames`` leaves no time to move.
    """
    _check_room(frames_per_joint, style)
    if not moved_joints or frames <= HOLD_FRAMES:
        raise ConfigError(
            f"long script: expected at least one joint and more than {HOLD_FRAMES} frames, got {len(moved_joints)} "
            f"joints and {frames} frames"
        )
    shares: list[Share] = []
    free = dict.fromkeys(moved_joints, 0)
    opened = dict.fromkeys(moved_joints, False)
    start = 0
    while start < frames:
        for joint in rng.permutation(moved_joints).tolist():
            length = max(round(rng.uniform(*_LONG_SHARE) * frames_per_joint), _shortest(style))
            start = max(start, free[joint])
            shares.append(_share(joint, start, length, style, opens=not opened[joint]))
            opened[joint] = not opened[joint]
            free[joint] = start + length
            start += round((1 - style.overlap) * length)
            if rng.random() < _PAUSE_OFTEN:
                start = max(start, *free.values()) + round(rng.uniform(*_PAUSE_S) * FRAMES_PER_S)
    return _played(articulation, shares, max(frames, *(s.end for s in shares)), rng, style)[:frames]


def sample_opening(articulation: Articulation, joint: int, rng: np.random.Generator) -> float:
    """Signed travel to the limit that is farther away; to either one if both are about as far (a bucket's handle)."""
    below, above = articulation.joints[joint].travel()
    draw = rng.random()
    if min(below, above) > 0.6 * max(below, above):
        return above if draw < 0.5 else -below
    return articulation.joints[joint].opening()


def _shortest(style: MotionStyle) -> int:
    return HOLD_FRAMES + sum(style.margin) + _MOVES_AT_LEAST


def _check_room(frames_per_joint: int, style: MotionStyle) -> None:
    if frames_per_joint < _shortest(style):
        raise ConfigError(
            f"frames per joint: expected at least {_shortest(style)} (a hold of {HOLD_FRAMES}, margins of "
            f"{style.margin[0]} and {style.margin[1]}, and time to move), got {frames_per_joint}"
        )


def _share(joint: int, start: int, frames: int, style: MotionStyle, *, opens: bool) -> Share:
    before, after = style.margin
    end = start + frames
    return Share(joint, start, max(start, HOLD_FRAMES) + before, end - after, end, opens)


def _played(
    articulation: Articulation, shares: list[Share], frames: int, rng: np.random.Generator, style: MotionStyle
) -> Float[np.ndarray, "T J"]:
    position = np.tile(articulation.rest, (frames, 1))
    now = {s.joint: 0.0 for s in shares}
    opening = dict(now)
    for s in shares:
        kind: ProfileKind = PROFILES[int(rng.integers(len(PROFILES)))] if style.kind == "mixed" else style.kind
        if s.opens:
            profile = draw_profile(kind, s.stops - s.moves, rng)
            opening[s.joint] = sample_opening(articulation, s.joint, rng)
        else:
            profile = draw_profile(kind, s.stops - s.moves, rng, closing_from=now[s.joint])
        opened = profile * opening[s.joint]
        rest = articulation.joints[s.joint].rest
        position[s.moves : s.stops, s.joint] = rest + opened
        position[s.stops :, s.joint] = rest + opened[-1]
        now[s.joint] = float(profile[-1])
    return position
