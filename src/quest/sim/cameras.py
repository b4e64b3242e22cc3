"""Cameras in front of an object: where they stand, how they are aimed, and how they move.

A camera turns about a thing, is held by a person, sits on a robot's head, or is knocked against. A direction of view
is written as the azimuth and elevation, in radians, of the ray from what is seen to the camera; the world is z up, and
azimuth 0 looks at the front (+x).

References: Flash and Hogan (1985) for the minimum-jerk movements; Elble (1996), Central mechanisms of tremor, for the
band of the hands' physiological tremor, 8 to 12 Hz.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from quest.errors import ConfigError, InputError
from quest.sim.motion import FRAMES_PER_S, minimum_jerk
from quest.types import Camera

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


CAMERA_AZIMUTH_DEG = 70.0
"""Cameras up to this far to either side of the front see past every distractor."""
AZIMUTH_DEG = (-60.0, 60.0)
ELEVATION_DEG = (5.0, 50.0)
FLAT_ELEVATION_DEG = (20.0, 65.0)
"""For objects that lie flat, of which a low camera would see an edge only."""
FIELD_OF_VIEW_DEG = (40.0, 60.0)
MIXED = "mixed"
"""Every camera draws one of :data:`CAMERA_MOTIONS`."""

_DISTINCT_DEG = 18.0

_LEAST_APART_RAD = 1e-6
"""Where directions can hardly differ, cameras may stand at one place."""
_FILL = (0.80, 0.97)
_ORBIT_FILL = (0.82, 0.95)
_HANDHELD_FILL = (0.75, 0.90)
_PAN_FILL = (0.55, 0.80)
_SHAKE_SHIFT = (0.004, 0.010)  # root mean square of each axis, per metre between camera and object
_SHAKE_TURN_DEG = (0.4, 1.0)  # root mean square about each axis
_NECK = (0.03, 0.10)  # from the axes of pan and tilt to the camera, per metre between camera and object
_WALK_FILL = (0.65, 0.85)
_WALK_M_PER_S = (0.2, 1.0)
_WALK_SHARE = (0.15, 0.6)  # of the distance to the object that is walked at most
_WALK_OBLIQUE_DEG = 70.0  # off a way straight past the object
_WALK_AIMED = (0.6, 1.0)
_STEPS_HZ = (1.5, 2.1)
_BOB_M = (0.005, 0.025)
_GLANCE = (0.3, 1.1)  # of the way from the middle of the object to one of its points
_CENTRE_WITHIN = 0.9  # of the half image, in which the object's centre stays while a head pans
_BUMP_TURN_DEG = (2.0, 4.0)
_BUMP_SHIFT = (0.005, 0.02)  # per metre between camera and world origin


@dataclass(frozen=True)
class PosedCamera:
    """A camera and where it stands."""

    camera: Camera
    cam_from_world: Float[np.ndarray, "4 4"]

    @property
    def eye(self) -> Float[np.ndarray, "3"]:
        """Where it stands in the world, metres."""
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]

    def distance_m(self, points: Float[np.ndarray, "N 3"]) -> float:
        """Along the line of sight, to the middle of some world points."""
        return float(self.cam_from_world[2, :3] @ points.mean(axis=0) + self.cam_from_world[2, 3])


@dataclass(frozen=True)
class CameraPath:
    """A camera and where it is at every frame."""

    camera: Camera
    cam_from_world: Float[np.ndarray, "S 4 4"]

    def __post_init__(self) -> None:
        shape = self.cam_from_world.shape
        if len(shape) != 3 or shape[0] == 0 or shape[1:] != (4, 4):
            raise InputError(f"camera path: expected one 4 x 4 pose per frame and at least one frame, got {shape}")
        if not np.isfinite(self.cam_from_world).all():
            raise InputError("camera path: expected finite poses, got NaN or infinity; check where they come from")

    def __len__(self) -> int:
        return len(self.cam_from_world)

    @classmethod
    def standing(cls, posed: PosedCamera, frames: int) -> CameraPath:
        """A camera that stays where it is."""
        return cls(posed.camera, np.tile(posed.cam_from_world, (frames, 1, 1)))

    @property
    def static(self) -> bool:
        """Whether the camera never moves."""
        return bool((self.cam_from_world == self.cam_from_world[0]).all())

    def at(self, t: int) -> PosedCamera:
        """The camera at a frame."""
        return PosedCamera(self.camera, self.cam_from_world[t])

    def kept(self, index: Int[np.ndarray, " T"]) -> CameraPath:
        """The same camera at some frames only."""
        return CameraPath(self.camera, self.cam_from_world[index])


@dataclass(frozen=True)
class CameraStyle:
    """Where cameras stand and how they move."""

    motion: str = "static"
    """One of :data:`CAMERA_MOTIONS`, or :data:`MIXED`."""
    azimuth_deg: tuple[float, float] = AZIMUTH_DEG
    """Range of the direction to the camera at the first frame; 0 is the front, positive towards +y."""
    elevation_deg: tuple[float, float] | None = None
    """Range of its height above the horizon at the first frame; None: by the object, higher for one that lies flat."""
    mirrored: bool = False
    """Whether half of the cameras stand on the other side, at minus that azimuth."""
    sweep_deg: float = 60.0
    """How far an orbit turns, at most 90."""
    turn: Literal["around", "over", "any"] = "any"
    """``around`` (in azimuth, and a little in elevation), ``over`` (from the side, within 10 degrees of the horizon, up
    to the top) or ``any`` (either one, or down from the top)."""

    def __post_init__(self) -> None:
        if self.motion not in (*CAMERA_MOTIONS, MIXED):
            raise ConfigError(
                f"camera motion: expected one of {', '.join((*CAMERA_MOTIONS, MIXED))}, got {self.motion!r}"
            )
        if self.turn not in ("around", "over", "any"):
            raise ConfigError(f"camera orbit: expected a turn around, over or any, got {self.turn!r}")
        azimuth, elevation = self.azimuth_deg, self.elevation_deg or ELEVATION_DEG
        for what, (low, high), least, most in (("azimuth", azimuth, -180, 180), ("elevation", elevation, 0, 89)):
            if not least <= low <= high <= most:
                raise ConfigError(
                    f"camera {what}: expected a range within {least} to {most} degrees, got {low} to {high}"
                )
        if not 0 < self.sweep_deg <= 90:
            raise ConfigError(
                f"camera orbit: expected a sweep of more than 0 and up to 90 degrees, got {self.sweep_deg}"
            )


@dataclass(frozen=True)
class PathRequest:
    """One camera that is to move."""

    points: Float[np.ndarray, "N 3"]
    """World points that it is to see: the object on the origin, in all its joint states."""
    direction: Float[np.ndarray, "3"]
    """Unit vector from the object to the camera at the first frame."""
    frames: int
    rng: np.random.Generator
    style: CameraStyle
    width: int
    height: int

    def camera(self, focal_px: float) -> Camera:
        """Its intrinsics."""
        return Camera(focal_px, focal_px, self.width / 2, self.height / 2, self.width, self.height)

    def aimed(self, fill_range: tuple[float, float] = _FILL) -> PosedCamera:
        """A camera that sees all points, which fill so much of the image."""
        fov = self.rng.uniform(*np.deg2rad(FIELD_OF_VIEW_DEG))
        fill = self.rng.uniform(*fill_range)
        roll = self.rng.normal(0.0, np.deg2rad(1.5))
        focal = max(self.width, self.height) / 2 / np.tan(fov / 2)
        forward = -self.direction
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
        rotation = np.stack((right, down, forward))
        local = self.points @ rotation.T
        slope = fill * np.array([self.width, self.height]) / 2 / focal
        # Smallest camera distance at which both sides of the image still hold every point, per image axis:
        # (x - cx) <= slope (z + d) for all points, and the mirrored inequality, solved for the centre cx and d.
        centre, distance = np.zeros(2), 0.0
        for axis in range(2):
            upper = (local[:, axis] - slope[axis] * local[:, 2]).max()
            lower = (local[:, axis] + slope[axis] * local[:, 2]).min()
            centre[axis] = (upper + lower) / 2
            distance = max(distance, (upper - lower) / 2 / slope[axis])
        eye_local = np.array([centre[0], centre[1], -distance])
        # Off-centre by part of the room that the fill factor leaves, as far as the nearest point has it.
        room = (1 - fill) / fill * (distance + local[:, 2].min()) * slope
        eye_local[:2] += np.clip(self.rng.uniform(-0.5, 0.5, size=2) * (1 - fill) * distance * slope, -room, room)
        cam_from_world = np.eye(4)
        cam_from_world[:3, :3] = rotation
        cam_from_world[:3, 3] = -eye_local
        return PosedCamera(self.camera(focal), cam_from_world)


def _elevation_range(points: Float[np.ndarray, "N 3"], style: CameraStyle) -> tuple[float, float]:
    if style.elevation_deg is not None:
        return style.elevation_deg
    extent = np.ptp(points, axis=0)
    return FLAT_ELEVATION_DEG if extent[2] < 0.35 * extent.max() else ELEVATION_DEG


def _directions(
    points: Float[np.ndarray, "N 3"], count: int, rng: np.random.Generator, style: CameraStyle
) -> list[np.ndarray]:
    """Unit vectors from the object to ``count`` cameras."""
    low, high = np.deg2rad(_elevation_range(points, style))
    directions: list[np.ndarray] = []
    apart = np.deg2rad(_DISTINCT_DEG)
    while len(directions) < count:
        azimuth, elevation = rng.uniform(*np.deg2rad(style.azimuth_deg)), rng.uniform(low, high)
        if style.mirrored and rng.random() < 0.5:
            azimuth = -azimuth
        direction = np.array(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        )
        if apart < _LEAST_APART_RAD or all(direction @ d < np.cos(apart) for d in directions):
            directions.append(direction)
        else:
            apart *= 0.97  # so that any number of cameras fits
    return directions


def _static(request: PathRequest) -> CameraPath:
    """The camera stands still."""
    return CameraPath.standing(request.aimed(), request.frames)


def _orbit(request: PathRequest) -> CameraPath:
    """The camera turns about the middle of all points, eased, at a distance at which all stay in the image."""
    points, rng = request.points, request.rng
    (from_azimuth, to_azimuth), (from_elevation, to_elevation) = _orbit_ends(request)
    width, height = request.width, request.height
    focal = max(width, height) / 2 / np.tan(rng.uniform(*np.deg2rad(FIELD_OF_VIEW_DEG)) / 2)
    slope = rng.uniform(*_ORBIT_FILL) * np.array([width, height]) / 2 / focal
    low, high = points.min(axis=0), points.max(axis=0)
    aim = (low + high) / 2 + rng.uniform(-0.05, 0.05, size=3) * (high - low)

    def looks(share: Float[np.ndarray, " S"]) -> tuple[np.ndarray, np.ndarray]:
        return look(
            from_azimuth + share * (to_azimuth - from_azimuth), from_elevation + share * (to_elevation - from_elevation)
        )

    # The path is gone at different speeds, also twice: its shape alone tells how far away it must stay.
    distance = 0.0
    for rotation in looks(np.linspace(0.0, 1.0, 181))[1]:
        local = (points - aim) @ rotation.T
        distance = max(distance, float((np.abs(local[:, :2]) / slope - local[:, 2:]).max()), float(-local[:, 2].min()))
    towards, rotation = looks(there_and_back(request.frames, rng))
    eye = aim + 1.01 * distance * towards  # between two of the directions tried, a little more may be needed
    return CameraPath(request.camera(focal), _poses(rotation, eye))


def _orbit_ends(request: PathRequest) -> tuple[tuple[float, float], tuple[float, float]]:
    """First and last azimuth, first and last elevation, radians."""
    direction, rng, style = request.direction, request.rng, request.style
    azimuth = float(np.arctan2(direction[1], direction[0]))
    elevation = float(np.arcsin(np.clip(direction[2], -1, 1)))
    limit = np.deg2rad(max(CAMERA_AZIMUTH_DEG, *np.abs(style.azimuth_deg)))
    sweep = np.deg2rad(style.sweep_deg)
    turn = style.turn if style.turn != "any" else rng.choice(["around", "over", "down"])
    if turn == "around":
        sides = [s for s in (-1.0, 1.0) if abs(azimuth + s * sweep) <= limit] or [-1.0, 1.0]
        side = sides[int(rng.integers(len(sides)))]
        start = float(np.clip(azimuth, *sorted((-side * limit, side * (limit - sweep)))))
        low, high = np.deg2rad(_elevation_range(request.points, style))
        end = float(np.clip(elevation + rng.uniform(-0.2, 0.2), low, high))
        return (start, start + side * sweep), (elevation, end)
    side_view = rng.uniform(0.0, min(np.deg2rad(10), np.pi / 2 - sweep))
    end = float(np.clip(azimuth + rng.uniform(-0.2, 0.2), -limit, limit))
    heights = (side_view, side_view + sweep)
    return (azimuth, end), heights if turn == "over" else heights[::-1]


def _handheld(request: PathRequest) -> CameraPath:
    """A person holds the camera, with drift and tremor: how unsteadily is drawn, shifts grow with the distance."""
    rng, posed = request.rng, request.aimed(_HANDHELD_FILL)
    distance = posed.distance_m(request.points)
    shake = hand_shake(request.frames, rng)
    turn = np.deg2rad(rng.uniform(*_SHAKE_TURN_DEG)) * shake[:, :3]
    shift = rng.uniform(*_SHAKE_SHIFT) * distance * shake[:, 3:]
    path = CameraPath.standing(posed, request.frames)
    return CameraPath(path.camera, displaced(path.cam_from_world, turn, shift))


def _pan(request: PathRequest) -> CameraPath:
    """A robot's base stands; its head, which carries the camera, pans and tilts between glances at the object."""
    points, rng, posed = request.points, request.rng, request.aimed(_PAN_FILL)
    start = posed.cam_from_world[:3, :3]
    azimuth, elevation = np.arctan2(-start[2, 1], -start[2, 0]), np.arcsin(np.clip(-start[2, 2], -1, 1))
    (towards,), (level,) = look(np.array([azimuth]), np.array([elevation]))
    rolled, eye = start @ level.T, posed.eye
    reach = rng.uniform(*_NECK) * posed.distance_m(points)
    centre = points.mean(axis=0)
    glance = rng.uniform(*_GLANCE, size=(32, 1))
    seen = eye - (centre + glance * (points[rng.integers(len(points), size=32)] - centre))
    pan = np.arctan2(seen[:, 1], seen[:, 0]) - azimuth
    tilt = np.arcsin(seen[:, 2] / np.linalg.norm(seen, axis=1)) - elevation
    targets = np.stack(((pan + np.pi) % (2 * np.pi) - np.pi, tilt), axis=-1)
    angles = fixations(targets, request.frames, rng)
    half = np.array([posed.camera.width, posed.camera.height]) / 2 / posed.camera.fx
    while True:
        facing, rotation = look(azimuth + angles[:, 0], elevation + angles[:, 1])
        poses = _poses(rolled @ rotation, eye + reach * (towards - facing))
        local = poses[:, :3, :3] @ centre + poses[:, :3, 3]
        if (np.abs(local[:, :2]) <= _CENTRE_WITHIN * half * local[:, 2:]).all() or np.abs(angles).max() < 1e-3:
            return CameraPath(posed.camera, poses)
        angles = 0.8 * angles


def _walk(request: PathRequest) -> CameraPath:
    """A person walks past the object, or up to it, with the camera in hand, and turns it towards the object.

    The head bobs once a step and sways once in two (Pozzo et al. 1990, head stabilization during various locomotor
    tasks); the camera is turned by most of what would keep the object where it is in the image.
    """
    rng, points, posed = request.rng, request.points, request.aimed(_WALK_FILL)
    start, eye, distance = posed.cam_from_world[:3, :3], posed.eye, posed.distance_m(points)
    seconds = np.arange(request.frames) / FRAMES_PER_S
    way = min(rng.uniform(*_WALK_M_PER_S) * seconds[-1], rng.uniform(*_WALK_SHARE) * distance)
    heading = rng.choice([0.0, np.pi]) + rng.uniform(-1, 1) * np.deg2rad(_WALK_OBLIQUE_DEG)
    along = np.cos(heading) * start[0] + np.sin(heading) * start[2]
    along[2] = 0.0
    step, phase = 2 * np.pi * rng.uniform(*_STEPS_HZ) * seconds, rng.uniform(0, 2 * np.pi)
    bob = rng.uniform(*_BOB_M) * np.stack((0.5 * np.sin(step / 2 + phase), np.sin(step + phase)), axis=-1)
    gone = way * (there_and_back(request.frames, rng)[:, None] - 0.5) * along
    path = eye + gone + bob[:, :1] * start[0] + bob[:, 1:] * [0.0, 0.0, 1.0]
    centre = points.mean(axis=0)
    aim = centre + (1 - rng.uniform(*_WALK_AIMED)) * (path - eye)
    (level,) = look(*_angles((eye - centre)[None]))[1]
    shake = np.deg2rad(rng.uniform(*_SHAKE_TURN_DEG)) * hand_shake(request.frames, rng)[:, :3]
    poses = _poses(start @ level.T @ look(*_angles(path - aim))[1], path)
    return CameraPath(posed.camera, displaced(poses, shake, np.zeros_like(shake)))


def _angles(towards: Float[np.ndarray, "S 3"]) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Azimuth and elevation of directions, radians."""
    level = np.hypot(towards[:, 0], towards[:, 1])
    return np.arctan2(towards[:, 1], towards[:, 0]), np.arctan2(towards[:, 2], level)


def _poses(rotation: Float[np.ndarray, "S 3 3"], eye: Float[np.ndarray, "S 3"]) -> Float[np.ndarray, "S 4 4"]:
    """``cam_from_world`` of cameras at world points."""
    poses = np.tile(np.eye(4), (len(rotation), 1, 1))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = -(rotation @ eye[:, :, None])[..., 0]
    return poses


CAMERA_MOTIONS: dict[str, Callable[[PathRequest], CameraPath]] = {
    "static": _static,
    "orbit": _orbit,
    "handheld": _handheld,
    "pan": _pan,
    "walk": _walk,
}
"""How a camera may move, by name; a new motion is a function and a line here."""


def sample_cameras(
    points: Float[np.ndarray, "N 3"],
    count: int,
    rng: np.random.Generator,
    *,
    width: int,
    height: int,
    style: CameraStyle = CameraStyle(),
) -> list[PosedCamera]:
    """Cameras, by default in the front hemisphere (+x), that see all ``points``, about 18 degrees apart or more.

    The points lie around the origin: the object in all its joint states. How the style moves does not matter here.
    """
    still = replace(style, motion="static")
    return [p.at(0) for p in sample_camera_paths(points, count, 1, rng, style=still, width=width, height=height)]


def sample_camera_paths(
    points: Float[np.ndarray, "N 3"],
    count: int,
    frames: int,
    rng: np.random.Generator,
    *,
    style: CameraStyle,
    width: int,
    height: int,
) -> list[CameraPath]:
    """Cameras that stand as those of :func:`sample_cameras` and move as the style says; also while nothing else moves.

    Static cameras are those of :func:`sample_cameras` and see all ``points``; so does an orbit at every frame. A
    handheld camera may cut a little off at the image's borders. A head that pans keeps the centre of the points in the
    image, and most of them. No azimuth goes beyond 70 degrees, up to which distractors hide nothing, except where the
    style asks for it.

    Raises:
        ConfigError: there is no frame.
    """
    if frames < 1:
        raise ConfigError(f"camera paths: expected at least one frame, got {frames}")
    directions = _directions(points, count, rng, style)
    names = list(CAMERA_MOTIONS)
    if style.motion == MIXED:
        motions = [names[int(rng.integers(len(names)))] for _ in directions]
    else:
        motions = [style.motion] * count
    return [
        CAMERA_MOTIONS[motion](PathRequest(points, direction, frames, rng, style, width, height))
        for direction, motion in zip(directions, motions, strict=True)
    ]


def bump(path: CameraPath, frame: int, rng: np.random.Generator) -> CameraPath:
    """The same camera, knocked at a frame: within three frames it has turned by 2 to 4 degrees and shifted a little.

    It rings for a moment and stays displaced. What was close to the image's border may leave the image.

    Raises:
        ConfigError: the frame is not one of the path's, or its first.
    """
    if not 1 <= frame < len(path):
        raise ConfigError(f"camera bump: expected a frame from 1 to {len(path) - 1}, got {frame}")
    # A knock turns a mount about its foot rather than about the line of sight.
    axis = rng.normal(size=3) * (1.0, 1.0, 0.5)
    turn = np.deg2rad(rng.uniform(*_BUMP_TURN_DEG)) * axis / np.linalg.norm(axis)
    side = rng.normal(size=3)
    distance = float(np.linalg.norm(path.cam_from_world[frame, :3, 3]))
    shift = rng.uniform(*_BUMP_SHIFT) * distance * side / np.linalg.norm(side)
    response = jolt(len(path), frame, rng)[:, None]
    moved = displaced(path.cam_from_world, response * turn, response * shift)
    moved[:frame] = path.cam_from_world[:frame]
    return CameraPath(path.camera, moved)
