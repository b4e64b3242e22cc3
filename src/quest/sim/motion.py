"""Motion scripts: which joint is where at every frame of a take.

Nothing moves in the first :data:`HOLD_FRAMES` frames. Then the chosen joints move one after the other,
``frames_per_joint`` frames each (the hold is part of the first joint's share), along minimum-jerk
segments of random amplitude with stops and partial returns. A joint stays where its share ends.

Reference: Flash and Hogan (1985), The coordination of arm movements, equation for the minimum-jerk trajectory.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from quest.errors import ConfigError
from quest.sim.articulation import Articulation

HOLD_FRAMES = 8
FRAMES_PER_S = 30.0
_AMPLITUDE = (0.6, 1.0)


def minimum_jerk(share: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Progress in [0, 1] at shares of the duration in [0, 1]; velocity and acceleration vanish at both ends."""
    return share**3 * (10 - 15 * share + 6 * share**2)


def joint_profile(frames: int, rng: np.random.Generator) -> Float[np.ndarray, " N"]:
    """How far a joint is open at each of its frames, as a share of its opening; starts near 0, reaches 0.6 to 1.

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
    # The end of the script may come a little before the end of the share: a last stop.
    weights = [*weights, rng.uniform(0.0, 0.15) * sum(weights)]
    knots = [*knots, knots[-1]]
    ends = np.concatenate(([0.0], np.cumsum(weights) / np.sum(weights)))
    share = np.arange(1, frames + 1) / frames
    segment = np.clip(np.searchsorted(ends, share, side="left") - 1, 0, len(weights) - 1)
    length = np.maximum(ends[segment + 1] - ends[segment], 1e-9)
    progress = minimum_jerk(np.clip((share - ends[segment]) / length, 0.0, 1.0))
    start, end = np.array(knots)[segment], np.array(knots)[segment + 1]
    return start + (end - start) * progress


def motion_script(
    articulation: Articulation, moved_joints: tuple[int, ...], rng: np.random.Generator, *, frames_per_joint: int = 60
) -> Float[np.ndarray, "T J"]:
    """Joint positions (radians or metres) at every frame of a take.

    Args:
        articulation: the object.
        moved_joints: joints that move, in order.
        rng: what the script is drawn from.
        frames_per_joint: frames that each joint gets; the hold is taken from the first one's.

    Raises:
        ConfigError: ``frames_per_joint`` leaves no time to move.
    """
    if frames_per_joint <= HOLD_FRAMES + 2:
        raise ConfigError(f"frames per joint: expected more than {HOLD_FRAMES + 2}, got {frames_per_joint}")
    position = np.tile(articulation.rest, (frames_per_joint * len(moved_joints), 1))
    for k, j in enumerate(moved_joints):
        start = HOLD_FRAMES if k == 0 else k * frames_per_joint
        end = (k + 1) * frames_per_joint
        opened = joint_profile(end - start, rng) * sample_opening(articulation, j, rng)
        position[start:end, j] += opened
        position[end:, j] += opened[-1]
    return position


def sample_opening(articulation: Articulation, joint: int, rng: np.random.Generator) -> float:
    """Signed travel to the limit that is farther away; to either one if both are about as far (a bucket's handle)."""
    below, above = articulation.joints[joint].travel()
    draw = rng.random()
    if min(below, above) > 0.6 * max(below, above):
        return above if draw < 0.5 else -below
    return articulation.joints[joint].opening()
