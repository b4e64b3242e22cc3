"""What all takes of a run, or of a suite, have in common."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any

from quest.errors import ConfigError
from quest.sim.cameras import CameraStyle
from quest.sim.motion import HOLD_FRAMES, MotionStyle
from quest.sim.props import DISTURBANCES, Disturbance
from quest.sim.sensor import SensorModel


@dataclass(frozen=True)
class TakeSettings:
    """How takes are made."""

    views: int = 3
    """How many cameras."""
    size: int | tuple[int, int] = 224
    """Width and height of the images, pixels; one number for square ones."""
    every: int = 1
    """Keep every n-th frame of the motion script."""
    frames_per_joint: int = 60
    """Frames of the script that each joint gets; takes in which things are hidden have scripts of their own."""
    frames: int | None = None
    """Length of a script in which joints open and close again and again; None for one share per joint."""
    randomize_materials: bool = True
    """Whether objects get random materials, beside random light and surroundings."""
    broad_materials: bool = False
    """Whether materials are drawn from all textures rather than the usual ones."""
    fixed_scene: bool = False
    """Whether all takes of an object show it in one scene from the same cameras; only its motion is then of the
    take."""
    cameras: CameraStyle = CameraStyle()
    """Where cameras stand and how they move."""
    motion: MotionStyle = MotionStyle()
    """How joints move."""
    physics: bool = False
    """Whether joints are driven through a physics engine along their script, or play it as it is."""
    gripper: bool = False
    """Whether a gripper pulls what moves."""
    hand: bool = False
    """Whether a person's hand does."""
    sensor: SensorModel = SensorModel()
    """What the sensor makes of colours and depth; the ground truth knows nothing of it."""
    disturbance: Disturbance = "none"
    """What happens to light, materials or cameras."""
    room: bool = False
    """Whether the object stands in a room, among other furniture that stands still."""
    things: str | None = None
    """Folder of things that stand on the furniture of rooms, one folder each (:func:`quest.sim.objects.find_things`);
    None for plain bottles and boxes."""
    stretch: float = 1.0
    """Up to which factor every take has the object stretched along its depth, width and height; 1 leaves it as it
    is."""

    def __post_init__(self) -> None:
        if self.views < 1 or min(self.width, self.height) < 16:
            raise ConfigError(
                f"take: expected at least 1 view of 16 x 16 pixels, got {self.views} of {self.width} x {self.height}"
            )
        if not 1 <= self.every <= HOLD_FRAMES:
            raise ConfigError(f"take: expected to keep every 1st to {HOLD_FRAMES}th frame, got every {self.every}")
        if self.frames is not None and self.frames <= self.frames_per_joint:
            raise ConfigError(
                f"take: expected more frames than one joint's share ({self.frames_per_joint}), got {self.frames}"
            )
        if self.gripper and self.hand:
            raise ConfigError("take: expected a gripper or a hand that pulls, got both; leave one away")
        if self.pulled and (self.frames is not None or self.motion.overlap > 0 or self.motion.cycles > 1):
            puller = "gripper" if self.gripper else "hand"
            raise ConfigError(
                f"take: a {puller} pulls one joint after the other, each once; leave overlap, cycles and frames away"
            )
        if self.things is not None and not self.room:
            raise ConfigError("take: things stand on the furniture of a room; ask for a room as well")
        if self.fixed_scene and self.stretch != 1:
            raise ConfigError("take: in a fixed scene only the motion is of the take; leave stretch away")
        if not 1 <= self.stretch <= 4:
            raise ConfigError(f"take: expected to stretch by a factor from 1 to 4, got {self.stretch}")
        if self.disturbance not in DISTURBANCES:
            raise ConfigError(
                f"take: unknown disturbance {self.disturbance!r}; expected one of {', '.join(DISTURBANCES)}"
            )

    @property
    def pulled(self) -> bool:
        """Whether something that is seen pulls what moves."""
        return self.gripper or self.hand

    @property
    def width(self) -> int:
        """Width of the images, pixels."""
        return self.size if isinstance(self.size, int) else self.size[0]

    @property
    def height(self) -> int:
        """Height of the images, pixels."""
        return self.size if isinstance(self.size, int) else self.size[1]

    @property
    def digest(self) -> str:
        """Short hash of what differs from the defaults: takes of one name and digest show the same."""
        return hashlib.sha256(json.dumps(_unusual(self, TakeSettings()), sort_keys=True).encode()).hexdigest()[:12]


def _unusual(settings: Any, ordinary: Any) -> dict[str, Any]:
    """Fields that differ, so that a field that comes with a later version changes no digest by its default."""
    found: dict[str, Any] = {}
    for f in fields(settings):
        value, usual = getattr(settings, f.name), getattr(ordinary, f.name)
        if value != usual:
            plain = asdict(value) if is_dataclass(value) and not isinstance(value, type) else value
            found[f.name] = _unusual(value, usual) if type(value) is type(usual) and plain is not value else plain
    return found
