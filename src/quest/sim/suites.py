"""Suites: takes that put one difficulty to a tracker, as named presets."""

from __future__ import annotations

from dataclasses import dataclass, replace

from quest.errors import ConfigError
from quest.sim.cameras import CAMERA_MOTIONS, CameraStyle
from quest.sim.motion import MotionStyle
from quest.sim.sensor import SENSORS, SensorModel
from quest.sim.settings import TakeSettings

HIDDEN_FRAMES = (10, 120)
"""How long an entity may be hidden, both included."""


@dataclass(frozen=True)
class Hiding:
    """How long entities are hidden, and beside what."""

    frames: int | None
    """Frames for which every moving entity is hidden; None draws them from 10 to 120, take by take."""
    look_alike: bool
    """Whether another entity of the same label stays in view meanwhile; if not, none is ever in view."""
    before: tuple[int, int]
    """Fewest and most frames of a joint's share before its entity is hidden; the hold is part of the first one's."""
    after: tuple[int, int]
    """Fewest and most frames of a joint's share that follow; in the first two or three the occluder is still
    leaving."""

    def __post_init__(self) -> None:
        low, high = HIDDEN_FRAMES
        if self.frames is not None and not low <= self.frames <= high:
            raise ConfigError(f"suite: expected entities hidden for {low} to {high} frames, got {self.frames}")

    def check(self, settings: TakeSettings) -> None:
        """Raise ConfigError unless some settings leave script and camera to the hiding."""
        if settings.views != 1:
            raise ConfigError(
                f"hidden entities: expected 1 view, for an occluder hides from one camera, got {settings.views}"
            )
        if settings.cameras.motion != "static" or settings.disturbance == "bump":
            raise ConfigError("hidden entities: expected a camera that stands still, an occluder hides from one place")
        if settings.motion != MotionStyle() or settings.frames or settings.physics or settings.pulled:
            raise ConfigError("hidden entities: joints move by a script of their own; leave other motions away")


@dataclass(frozen=True)
class Suite:
    """What sets the takes of a suite apart from ordinary ones."""

    name: str
    """A key of :data:`SUITES`."""
    variant: str = ""
    """Which of the suite's kinds, such as ``blur``; empty if there is only one."""
    settings: TakeSettings = TakeSettings(views=1)
    """How its takes are made unless a run says otherwise."""
    hiding: Hiding | None = None
    """What is hidden when, or None if nothing is."""
    level: int = 1
    """How many joints move unless a run says otherwise."""
    category: str | None = None
    """The only category of procedural objects that it takes, or None for all objects."""

    def __post_init__(self) -> None:
        if self.hiding is not None:
            self.hiding.check(self.settings)

    @property
    def tag(self) -> str:
        """What the names of its takes carry, such as ``occlusion60alike`` or ``shift-blur``."""
        if self.hiding is None:
            return f"{self.name}-{self.variant}" if self.variant else self.name
        alike = "alike" if self.hiding.look_alike and self.category is None else ""
        return f"{self.name}{'' if self.hiding.frames is None else self.hiding.frames}{alike}"

    def hidden_for(self, frames: int | None = None, *, look_alike: bool = False) -> Suite:
        """The same suite with entities hidden for so many frames, or beside look-alikes.

        Raises:
            ConfigError: nothing is hidden in this suite, it always has look-alikes, or the frames are out of range.
        """
        if frames is None and not look_alike:
            return self
        if self.hiding is None:
            raise ConfigError(f"suite {self.name}: nothing is hidden in it; expected one of occlusion, lockers")
        if look_alike and self.hiding.look_alike:
            raise ConfigError(f"suite {self.name}: it always has look-alikes; leave --look-alike away")
        hiding = replace(
            self.hiding,
            frames=self.hiding.frames if frames is None else frames,
            look_alike=self.hiding.look_alike or look_alike,
        )
        return replace(self, hiding=hiding)


def _with(**changes: object) -> TakeSettings:
    return replace(TakeSettings(views=1), **changes)


_ODD_VIEWPOINT = CameraStyle(azimuth_deg=(50.0, 70.0), elevation_deg=(55.0, 75.0), mirrored=True)
_IN_A_ROOM = CameraStyle(motion="handheld", azimuth_deg=(-50.0, 50.0), elevation_deg=(0.0, 40.0))

SUITES: dict[str, tuple[Suite, ...]] = {
    "occlusion": (Suite("occlusion", hiding=Hiding(None, False, before=(34, 41), after=(24, 30))),),
    "lockers": (
        Suite(
            "lockers",
            hiding=Hiding(30, True, before=(24, 24), after=(6, 6)),
            level=4,
            category="locker_bank",
        ),
    ),
    "noise": (
        *(Suite("noise", str(n), _with(sensor=SensorModel(rgb_noise=n / 100))) for n in (0, 1, 2, 5, 10)),
        *(Suite("noise", name, _with(sensor=SENSORS[name])) for name in ("structured-light", "stereo")),
    ),
    "shift": (
        Suite("shift", "light", _with(disturbance="light")),
        Suite("shift", "texture", _with(disturbance="texture")),
        Suite("shift", "blur", _with(sensor=SensorModel(blur_px=2.0))),
        Suite("shift", "jpeg", _with(sensor=SensorModel(jpeg_quality=12))),
        Suite("shift", "bump", _with(disturbance="bump")),
        Suite("shift", "viewpoint", _with(cameras=_ODD_VIEWPOINT)),
    ),
    "moving": tuple(
        Suite("moving", motion, _with(cameras=CameraStyle(motion=motion)))
        for motion in CAMERA_MOTIONS
        if motion != "static"
    ),
    "gripper": (Suite("gripper", settings=_with(gripper=True, frames_per_joint=90)),),
    "hands": (Suite("hands", settings=_with(hand=True, frames_per_joint=90, cameras=CameraStyle(motion="handheld"))),),
    "kitchen": (Suite("kitchen", settings=_with(room=True, size=(640, 480), cameras=_IN_A_ROOM)),),
    "long": (Suite("long", settings=_with(frames=10_000), level=2),),
    "published": (Suite("published", settings=_with(views=3, randomize_materials=False, fixed_scene=True)),),
}
"""The presets, each with its variants:

- ``occlusion``: an entity hidden for 10 to 120 frames while it moves on and stops;
- ``lockers``: banks of sixteen like doors, hidden for 30 frames each;
- ``noise``: Gaussian noise of 0, 1, 2, 5, 10 % on the colours, or the depth of a structured-light or stereo sensor;
- ``shift``: light that changes, odd materials, blur, JPEG, a bumped camera, a camera high above or far to the side;
- ``moving``: a camera that orbits, is held by hand, or sits on a robot's head;
- ``gripper``: a gripper comes, pulls, and goes;
- ``hands``: a person's hand does, seen by a camera that is held by hand;
- ``kitchen``: the object in a row of other furniture, with things on top and cupboards above, before a hand-held
  camera that is near or far;
- ``long``: 10,000 frames in which two joints open and close again and again;
- ``published``: as the publication seems to have filmed: three cameras that stand where they stand for all takes of an
  object, in its own materials, under one light; only the motion is another in every take.

Takes of one object, level and seed show the motion of the ordinary take of that seed in all variants of ``noise``,
``shift`` and ``moving``, so that they can be compared in pairs.
"""


def find_suites(name: str, variants: tuple[str, ...] = ()) -> tuple[Suite, ...]:
    """Variants of a suite, all of them by default.

    Raises:
        ConfigError: there is no such suite or variant.
    """
    if name not in SUITES:
        raise ConfigError(f"suite {name!r}: no such suite; expected one of {', '.join(SUITES)}")
    known = {suite.variant: suite for suite in SUITES[name]}
    for variant in variants:
        if variant not in known:
            offered = ", ".join(filter(None, known)) or "none, it has only one kind"
            raise ConfigError(f"suite {name}: unknown variant {variant!r}; expected {offered}")
    return tuple(known[variant] for variant in variants) or SUITES[name]
