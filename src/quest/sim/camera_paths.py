"""How a camera moves: turning about a thing, held by a person, on a robot's head, knocked against.

Everything here is plain arrays, one row per frame. A direction of view is written as the azimuth and elevation, in
radians, of the ray from what is seen to the camera; the world is z up, and azimuth 0 looks at the front (+x).
:mod:`quest.sim.cameras` turns these into cameras.

References: Flash and Hogan (1985) for the minimum-jerk movements; Elble (1996), Central mechanisms of tremor, for the
band of the hands' physiological tremor, 8 to 12 Hz.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from quest.sim.profiles import FRAMES_PER_S, minimum_jerk

_LEG_FRAMES = 300
_DRIFT_HZ = (0.1, 2.0)
_TREMOR_HZ = (8.0, 12.0)
_TREMOR_SHARE = 0.04
_LOOP_FRAMES = 600
_DWELL_S = (0.3, 2.0)
_SPEED_RAD_S = (0.25, 1.0)
_SHORTEST_MOVE_S = 0.25
_JOLT_HZ = (4.0, 6.0)
_JOLT_DAMPING = (0.35, 0.6)
_JOLT_S = 1.0


def look(
    azimuth: Float[np.ndarray, " S"], elevation: Float[np.ndarray, " S"]
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3 3"]]:
    """Unit vectors towards the camera, and rotations ``cam_from_world`` of level cameras that look back along them.

    Straight above (elevation pi / 2) is no special case: the azimuth says which way is up in the image.
    """
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    towards = np.stack((ca * ce, sa * ce, se), axis=-1)
    right = np.stack((-sa, ca, np.zeros_like(sa)), axis=-1)
    return towards, np.stack((right, np.cross(-towards, right), -towards), axis=-2)


def there_and_back(frames: int, rng: np.random.Generator) -> Float[np.ndarray, " S"]:
    """Progress from 0 to 1 along a path, eased at both ends, with short stops there.

    The way is gone once in up to 450 frames; in longer takes it is gone there and back, about 300 frames each way.
    """
    legs = max(1, round(frames / _LEG_FRAMES))
    ends = np.round(np.linspace(0, frames, legs + 1)).astype(int)
    progress = np.empty(frames)
    for leg in range(legs):
        count = ends[leg + 1] - ends[leg]
        before, after = rng.uniform(0.0, 0.12, size=2)
        share = np.linspace(0.0, 1.0, count) if count > 1 else np.zeros(1)
        gone = minimum_jerk(np.clip((share - before) / (1 - before - after), 0.0, 1.0))
        progress[ends[leg] : ends[leg + 1]] = gone if leg % 2 == 0 else 1 - gone
    return progress


def hand_shake(frames: int, rng: np.random.Generator) -> Float[np.ndarray, "S 6"]:
    """Six independent signals of root mean square 1: slow drift, and in it the tremor of the hands.

    The drift falls off with the frequency from 0.1 to 2 Hz, so that its power goes with 1 / f^2 as that of standing
    people; the tremor, 8 to 12 Hz, has 4 % of its amplitude. There is nothing in between and nothing above.
    """
    loop = max(frames, _LOOP_FRAMES)
    frequency = np.fft.rfftfreq(loop, 1 / FRAMES_PER_S)
    drift = np.where((frequency >= _DRIFT_HZ[0]) & (frequency <= _DRIFT_HZ[1]), 1 / np.maximum(frequency, 1e-9), 0.0)
    tremor = np.where((frequency >= _TREMOR_HZ[0]) & (frequency <= _TREMOR_HZ[1]), 1.0, 0.0)
    strength = drift / np.linalg.norm(drift) + _TREMOR_SHARE * tremor / np.linalg.norm(tremor)
    strength *= loop / np.sqrt(2 * np.sum(strength**2))
    phase = rng.uniform(0, 2 * np.pi, size=(6, len(frequency)))
    signals = np.fft.irfft(strength * np.exp(1j * phase), n=loop, axis=-1)
    # Any stretch of the loop will do: it has no beginning.
    return signals[:, :frames].T.copy()


def fixations(targets: Float[np.ndarray, "N 2"], frames: int, rng: np.random.Generator) -> Float[np.ndarray, "S 2"]:
    """Pan and tilt of a head that looks from target to target, radians.

    The head rests on each for 0.3 to 2 s and goes to the next by a minimum-jerk movement of 15 to 60 degrees/s on
    average; both angles start and stop together. It starts at (0, 0).

    Args:
        targets: pan and tilt that are drawn from.
        frames: length of the take.
        rng: what order and times are drawn from.
    """
    angles = np.empty((frames, 2))
    now, t = np.zeros(2), 0
    while t < frames:
        dwell = round(rng.uniform(*_DWELL_S) * FRAMES_PER_S)
        angles[t : t + dwell] = now
        t += dwell
        target = targets[rng.integers(len(targets))]
        seconds = max(_SHORTEST_MOVE_S, float(np.linalg.norm(target - now)) / rng.uniform(*_SPEED_RAD_S))
        count = max(2, round(seconds * FRAMES_PER_S))
        share = minimum_jerk(np.arange(1, count + 1) / count)[:, None]
        part = angles[t : t + count]
        part[:] = (now + (target - now) * share)[: len(part)]
        now, t = target, t + count
    return angles


def jolt(frames: int, at: int, rng: np.random.Generator) -> Float[np.ndarray, " S"]:
    """Response of a mount that is knocked: 0 before frame ``at``, beyond 1 within three frames, ringing down to 1.

    The step response of a damped oscillator of 4 to 6 Hz; exactly 1 after a second.
    """
    turn, damping = 2 * np.pi * rng.uniform(*_JOLT_HZ), rng.uniform(*_JOLT_DAMPING)
    seconds = (np.arange(frames) - at + 1) / FRAMES_PER_S
    swing = np.cos(turn * seconds) + damping / np.sqrt(1 - damping**2) * np.sin(turn * seconds)
    decay = np.exp(-damping / np.sqrt(1 - damping**2) * turn * np.clip(seconds, 0, _JOLT_S))
    response = 1 - decay * swing
    return np.where(seconds <= 0, 0.0, np.where(seconds > _JOLT_S, 1.0, response))


def displaced(
    cam_from_world: Float[np.ndarray, "S 4 4"],
    turn_rad: Float[np.ndarray, "S 3"],
    shift_m: Float[np.ndarray, "S 3"],
) -> Float[np.ndarray, "S 4 4"]:
    """Cameras after a displacement given in their own axes: a rotation vector and a shift per frame."""
    new_from_cam = np.tile(np.eye(4), (len(cam_from_world), 1, 1))
    new_from_cam[:, :3, :3] = Rotation.from_rotvec(turn_rad).as_matrix()
    new_from_cam[:, :3, 3] = shift_m
    return new_from_cam @ cam_from_world
