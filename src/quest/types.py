"""Cameras, frames, clips, queries, tracks and takes: the records that every room exchanges.

All records are frozen dataclasses over numpy arrays. Pixels are ``(x, y)`` with centres at half-integers, so that an
image spans ``[0, W] x [0, H]``. Camera axes are OpenCV's (x right, y down, z forward). Lengths are metres, angles
radians, times seconds. Depth is along +z; 0 means missing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from quest.errors import InputError

LABELS = ("handle", "knob", "rim", "front")
"""Labels of the entities that a tracker follows, in the order of the network's outputs."""
INTENTS = ("open", "lift")
"""What one takes hold of an entity for: to move its joint, or to lift the whole thing by its base."""


class State(StrEnum):
    """What a query is doing at a frame."""

    TRACKING = "tracking"
    HELD = "held"
    LOST = "lost"


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

    Attributes:
        fx: focal length along x, pixels.
        fy: focal length along y, pixels.
        cx: principal point x, pixels; centres at half-integers.
        cy: principal point y, pixels; centres at half-integers.
        width: image width, pixels.
        height: image height, pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        if not np.isfinite(values).all() or self.fx < 0.01 * self.width or self.fy < 0.01 * self.height:  # 179 degrees
            raise InputError(f"camera: expected intrinsics in pixels, fx, fy > 0.01 of the size, got {values}")
        if min(self.width, self.height) <= 0 or self.width % 1 or self.height % 1:
            raise InputError(f"camera: expected a size of > 0 whole pixels, got {self.width} x {self.height}")
        if not (-self.width <= self.cx <= 2 * self.width and -self.height <= self.cy <= 2 * self.height):
            raise InputError(
                f"camera: principal point ({self.cx:.1f}, {self.cy:.1f}) lies far outside the "
                f"{self.width} x {self.height} image; check that the intrinsics belong to this image size"
            )
        for name in self.__dataclass_fields__:  # numbers of numpy are no JSON
            object.__setattr__(self, name, np.asarray(getattr(self, name)).item())

    @classmethod
    def from_opencv(cls, matrix: Float[np.ndarray, "3 3"], *, width: int, height: int) -> Camera:
        """Camera from an OpenCV or ROS matrix, whose pixel centres lie at integers (0.5 is added)."""
        fx, cx, fy, cy = np.asarray(matrix, dtype=np.float64)[[0, 0, 1, 1], [0, 2, 1, 2]].tolist()
        return cls(fx, fy, cx + 0.5, cy + 0.5, width, height)

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Intrinsic matrix in this project's half-integer convention."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)


@dataclass(frozen=True)
class Frame:
    """One RGB-D image.

    Attributes:
        rgb: colours.
        depth_m: depth along +z in metres, 0 where missing; None without a depth sensor.
        stamp_s: time in seconds.
        cam_from_world: pose; the identity if unknown (the world is then the camera).
    """

    rgb: UInt8[np.ndarray, "H W 3"]
    depth_m: Float32[np.ndarray, "H W"] | None
    stamp_s: float
    cam_from_world: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True)
class Clip:
    """RGB-D frames of one camera.

    Attributes:
        name: what to call the clip in files and tables.
        camera: intrinsics of every frame.
        rgb: colours.
        depth_m: depth along +z in metres, 0 where missing; None without a depth sensor.
        stamp_s: times in seconds, not decreasing.
        cam_from_world: pose per frame; identities if unknown.
    """

    name: str
    camera: Camera
    rgb: UInt8[np.ndarray, "T H W 3"]
    depth_m: Float32[np.ndarray, "T H W"] | None
    stamp_s: Float[np.ndarray, " T"]
    cam_from_world: Float[np.ndarray, "T 4 4"]

    def __post_init__(self) -> None:
        if self.rgb.ndim != 4 or self.rgb.shape[3] != 3 or self.rgb.dtype != np.uint8:
            raise InputError(f"clip: expected colours [T, H, W, 3] of uint8, got {self.rgb.shape} of {self.rgb.dtype}")
        t, h, w = self.rgb.shape[:3]
        if t == 0:
            raise InputError(f"clip {self.name!r}: expected at least one frame, got none")
        if (h, w) != (self.camera.height, self.camera.width):
            raise InputError(
                f"clip {self.name!r}: frames are {w} x {h} but the camera is for "
                f"{self.camera.width} x {self.camera.height}; give the intrinsics of these frames"
            )
        if self.depth_m is not None and self.depth_m.shape != (t, h, w):
            raise InputError(f"clip {self.name!r}: expected depth of shape {(t, h, w)}, got {self.depth_m.shape}")
        if self.stamp_s.shape != (t,) or self.cam_from_world.shape != (t, 4, 4):
            got = f"{self.stamp_s.shape} and {self.cam_from_world.shape}"
            raise InputError(f"clip {self.name!r}: expected {t} time stamps and poses, got {got}")
        finite = all(np.isfinite(values).all() for values in (self.cam_from_world, self.stamp_s))
        if not finite or (np.diff(self.stamp_s) < 0).any():
            raise InputError(f"clip {self.name!r}: stamps and poses must be finite, times not falling; sort the frames")

    def __len__(self) -> int:
        return len(self.rgb)

    def frame(self, t: int) -> Frame:
        """Frame ``t``."""
        depth = None if self.depth_m is None else self.depth_m[t]
        return Frame(self.rgb[t], depth, float(self.stamp_s[t]), self.cam_from_world[t])


@dataclass(frozen=True)
class Query:
    """What the user asks to follow. Use :meth:`slot`, :meth:`semantic` or :meth:`point`.

    Attributes:
        kind: ``slot`` (discover anything), ``semantic`` (a label), ``point`` (a pixel in a frame).
        name: how to call the answer; made up from the kind where empty.
        label: one of :data:`LABELS`, or None if unknown.
        frame: frame index of a point query.
        uv_px: pixel of a point query, in the source image.
        intent: one of :data:`INTENTS`, or None for either.
    """

    kind: Literal["slot", "semantic", "point"]
    name: str = ""
    label: str | None = None
    frame: int = 0
    uv_px: tuple[float, float] | None = None
    intent: str | None = None

    def __post_init__(self) -> None:
        for what, said, known in (("label", self.label, LABELS), ("intent", self.intent, INTENTS)):
            if said is not None and said not in known:
                raise InputError(f"query: {what} {said!r} is unknown; expected one of {', '.join(known)}")
        if (self.kind == "point") != (self.uv_px is not None):
            raise InputError("query: a point query needs a pixel, the other kinds take none")
        if self.uv_px is not None and not np.isfinite(self.uv_px).all():
            raise InputError(f"query: expected a finite pixel (x, y), got {self.uv_px}")
        if self.frame < 0:
            raise InputError(f"query: expected a frame index >= 0, got {self.frame}")

    @classmethod
    def slot(cls, name: str = "") -> Query:
        """Follow whatever entity the network discovers."""
        return cls("slot", name)

    @classmethod
    def semantic(cls, label: str, name: str = "", *, intent: str | None = None) -> Query:
        """Follow the most confident entity of a label, and of an intent if one is given."""
        return cls("semantic", name, label, intent=intent)

    @classmethod
    def point(cls, frame: int, x: float, y: float, *, name: str = "", label: str | None = None) -> Query:
        """Follow the entity at pixel ``(x, y)`` of frame ``frame``."""
        return cls("point", name, label, frame, (x, y))


@dataclass(frozen=True)
class Joints:
    """The joints that explain K tracks, in the world.

    Attributes:
        kind: ``static``, ``prismatic``, ``revolute``, or ``unknown`` where nothing was seen.
        axis: unit direction of sliding, or of the axis of turning; NaN where there is none.
        origin: metres: a point of the axis of turning, or of the path of sliding; NaN where unknown.
    """

    kind: tuple[str, ...]
    axis: Float32[np.ndarray, "K 3"]
    origin: Float32[np.ndarray, "K 3"]

    def select(self, queries: np.ndarray) -> Joints:
        """The joints of some queries only."""
        return Joints(tuple(self.kind[i] for i in queries), self.axis[queries], self.origin[queries])


@dataclass(frozen=True)
class Tracks:
    """Answers to K queries over T frames.

    Attributes:
        names: name per query.
        labels: label per query, or None.
        uv_px: pixel in the source image; NaN before a query is bound.
        point_world: world point in metres; NaN before binding and where it cannot be lifted.
        confidence: probability that the identity is still right, 0 before binding.
        visible: whether the entity is seen.
        state: :class:`State` value per frame and query.
        stamp_s: times in seconds.
        frame_flags: degradations of whole frames or of the whole clip, in words.
        lost_p: calibrated probability that the identity is lost, NaN where unknown; None without a monitor.
        alarm: whether an alarm is open; None likewise.
        joints: what explains the tracks at the end; None without grounding.
    """

    names: tuple[str, ...]
    labels: tuple[str | None, ...]
    uv_px: Float32[np.ndarray, "T K 2"]
    point_world: Float32[np.ndarray, "T K 3"]
    confidence: Float32[np.ndarray, "T K"]
    visible: Bool[np.ndarray, "T K"]
    state: np.ndarray
    stamp_s: Float[np.ndarray, " T"]
    frame_flags: tuple[str, ...] = ()
    lost_p: Float32[np.ndarray, "T K"] | None = None
    alarm: Bool[np.ndarray, "T K"] | None = None
    joints: Joints | None = None

    def __len__(self) -> int:
        return len(self.uv_px)

    def select(self, queries: list[int] | np.ndarray) -> Tracks:
        """The same tracks of some queries only."""
        index = np.asarray(queries, dtype=int)
        return replace(
            self,
            names=tuple(self.names[i] for i in index),
            labels=tuple(self.labels[i] for i in index),
            uv_px=self.uv_px[:, index],
            point_world=self.point_world[:, index],
            confidence=self.confidence[:, index],
            visible=self.visible[:, index],
            state=self.state[:, index],
            lost_p=None if self.lost_p is None else self.lost_p[:, index],
            alarm=None if self.alarm is None else self.alarm[:, index],
            joints=None if self.joints is None else self.joints.select(index),
        )


@dataclass(frozen=True)
class Joint:
    """A joint of a simulated object.

    Attributes:
        name: name in the URDF.
        kind: ``revolute`` or ``prismatic``.
        lower: lower limit of the model, radians or metres.
        upper: upper limit of the model, radians or metres; scripts open a hinge by at most 110 degrees.
    """

    name: str
    kind: Literal["revolute", "prismatic"]
    lower: float
    upper: float


@dataclass(frozen=True)
class Entity:
    """A physical point on one link that can be followed.

    Attributes:
        name: unique within the object, such as ``link_0/handle``.
        label: one of :data:`LABELS`, or ``hinge`` (reported apart, never scored).
        link: index of its link in the take's link arrays; 0 is the base, which never moves.
        joint: index of its joint in the take's joint arrays; -1 if it is fixed in the base (see :attr:`fixed`).
    """

    name: str
    label: str
    link: int
    joint: int

    @property
    def fixed(self) -> bool:
        """Whether no joint moves it, such as the rim of a laptop's base."""
        return self.joint < 0

    @property
    def intent(self) -> str:
        """What one takes hold of it for (see :data:`INTENTS`): ``open`` what a joint moves, ``lift`` what is fixed."""
        return "lift" if self.fixed else "open"


@dataclass(frozen=True)
class TakeInfo:
    """Where a take comes from and what is in it.

    Attributes:
        name: unique in its store.
        source: ``partnet-mobility``, ``procedural``, or ``own`` for a user's own object.
        object_id: folder name, or ``category-seed`` of a procedural object.
        category: such as ``StorageFurniture``.
        level: how many joints move one after the other.
        seed: seed of everything random in the take.
        half_diagonal_m: half the diagonal of the object's bounding box at rest, the unit of normalised distances.
        frames_per_s: frame rate that the time stamps follow.
        entities: what can be followed; hinges last.
        joints: moving joints.
        moved_joints: the joints that move in this take, in order, as indices into ``joints``.
        provenance: commit, versions of the packages that made the data, renderer, command.
        suite: which of the simulator's suites it belongs to; ``standard`` is none.
    """

    name: str
    source: Literal["partnet-mobility", "procedural", "own"]
    object_id: str
    category: str
    level: int
    seed: int
    half_diagonal_m: float
    frames_per_s: float
    entities: tuple[Entity, ...]
    joints: tuple[Joint, ...]
    moved_joints: tuple[int, ...]
    provenance: dict[str, Any] = field(default_factory=dict)
    suite: str = "standard"


@dataclass(frozen=True)
class View:
    """One camera's frames of a take with their ground truth (a :class:`Clip` and what is true of it).

    Attributes:
        clip: the frames.
        uv_px: true pixel per entity, also where occluded or outside the image; NaN behind the camera.
        visible: whether the entity is seen.
        link_id: 0 background, else 1 + link index.
        entity_id: affordance mask: 0 nothing, else 1 + entity index.
    """

    clip: Clip
    uv_px: Float32[np.ndarray, "T E 2"]
    visible: Bool[np.ndarray, "T E"]
    link_id: UInt8[np.ndarray, "T H W"]
    entity_id: UInt8[np.ndarray, "T H W"]


@dataclass(frozen=True)
class Take:
    """One event seen by V views, with ground truth in the world frame.

    Attributes:
        info: description.
        views: one per camera.
        stamp_s: times, shared by all views.
        point_world: true world point per entity.
        flow_world: displacement of each entity to the next frame; 0 at the last.
        link_pose: ``world_from_link`` per link.
        joint_position: radians or metres.
        joint_velocity: per second.
        joint_axis: origin and unit direction of each joint's axis in the world.
    """

    info: TakeInfo
    views: tuple[View, ...]
    stamp_s: Float[np.ndarray, " T"]
    point_world: Float32[np.ndarray, "T E 3"]
    flow_world: Float32[np.ndarray, "T E 3"]
    link_pose: Float32[np.ndarray, "T L 4 4"]
    joint_position: Float32[np.ndarray, "T J"]
    joint_velocity: Float32[np.ndarray, "T J"]
    joint_axis: Float32[np.ndarray, "T J 6"]

    def __len__(self) -> int:
        return len(self.stamp_s)

    @property
    def tracked(self) -> Int[np.ndarray, " E"]:
        """Indices of the entities that a tracker follows (hinges are left out)."""
        return np.array([i for i, e in enumerate(self.info.entities) if e.label in LABELS], dtype=int)

    @property
    def moved(self) -> Bool[np.ndarray, " E"]:
        """Which entities are at some time more than 0.1 normalised units from where they were at rest."""
        distance = np.linalg.norm(self.point_world - self.point_world[:1], axis=-1).max(axis=0)
        return distance > 0.1 * self.info.half_diagonal_m
