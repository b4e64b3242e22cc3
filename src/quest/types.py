"""Cameras, frames, clips, queries, tracks and takes: the records that every room exchanges.

All records are frozen dataclasses over numpy arrays. Pixels are ``(x, y)`` with centres at half-integers, so that an
image spans ``[0, W] x [0, H]``. Camera axes are OpenCV's (x right, y down, z forward). Lengths are metres, angles
radians, times seconds. Depth is along +z; 0 means missing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from quest.depth import check_units, clean_depth
from quest.errors import InputError
from quest.tracks import Joints as Joints
from quest.tracks import State as State
from quest.tracks import Tracks as Tracks

GRIPS = ("handle", "knob")
"""Labels of parts made to be gripped, which have an outline of their own; the others are places on a link."""
LABELS = (*GRIPS, "rim", "front")
"""Labels of the entities that a tracker follows, in the order of the network's outputs."""
INTENTS = ("open", "lift")
"""What one takes hold of an entity for: to move its joint, or to lift the whole thing by its base."""
GUESSED_CAMERA = "camera guessed: a focal length as long as the longer side (53 degrees); give the camera or fov_deg"
_FRAMES_PER_S = 30.0


MOST_SIDE_PX = 2**15
"""Longest side of a picture, pixels."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion."""

    fx: float
    """Focal length along x, pixels."""
    fy: float
    """Focal length along y, pixels."""
    cx: float
    """Principal point x, pixels; centres at half-integers."""
    cy: float
    """Principal point y, pixels; centres at half-integers."""
    width: int
    """Image width, pixels."""
    height: int
    """Image height, pixels."""

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        size = np.array([self.width, self.height])
        if not np.isfinite(size).all() or (size <= 0).any() or (size % 1).any() or (size > MOST_SIDE_PX).any():
            raise InputError(
                f"camera: expected sides of 1 to {MOST_SIDE_PX} whole pixels, got {self.width} x {self.height}"
            )
        share = np.array([self.fx, self.fy]) / size
        if not np.isfinite(values).all() or (share < 0.01).any() or (share > 1e3).any():  # 179 to 0.06 degrees
            raise InputError(
                f"camera: expected intrinsics in pixels, fx, fy of 0.01 to 1,000 times the size, got {values}"
            )
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

    @classmethod
    def from_fov(cls, width: int, height: int, fov_deg: float | int | None = None) -> Camera:
        """Camera of unknown intrinsics: square pixels, and the principal point in the middle.

        Args:
            width: image width, pixels.
            height: image height, pixels.
            fov_deg: field of view along the longer side, degrees. None is a guess that suits most webcams and phones: a
                focal length as long as the longer side, which is 53 degrees.

        Raises:
            InputError: the field of view is not between 1 and 175 degrees.
        """
        longer = float(max(width, height))
        if fov_deg is None:
            focal = longer
        elif 1 <= fov_deg <= 175:
            focal = longer / 2 / float(np.tan(np.radians(fov_deg) / 2))
        else:
            raise InputError(f"camera: expected a field of view of 1 to 175 degrees, got {fov_deg}")
        return cls(focal, focal, width / 2, height / 2, width, height)

    def __repr__(self) -> str:
        numbers = f"fx {self.fx:.1f}, fy {self.fy:.1f}, cx {self.cx:.1f}, cy {self.cy:.1f}"
        return f"Camera({self.width} x {self.height} px, {numbers})"

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Intrinsic matrix in this project's half-integer convention."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)


@dataclass(frozen=True)
class Frame:
    """One RGB-D image."""

    rgb: UInt8[np.ndarray, "H W 3"]
    """Colours."""
    depth_m: Float32[np.ndarray, "H W"] | None
    """Depth along +z in metres, 0 where missing; None without a depth sensor."""
    stamp_s: float
    """Time in seconds."""
    cam_from_world: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Pose; the identity if unknown (the world is then the camera)."""


@dataclass(frozen=True)
class Clip:
    """RGB-D frames of one camera."""

    name: str
    """What to call the clip in files and tables."""
    camera: Camera
    """Intrinsics of every frame."""
    rgb: UInt8[np.ndarray, "T H W 3"]
    """Colours."""
    depth_m: Float32[np.ndarray, "T H W"] | None
    """Depth along +z in metres, 0 where missing; None without a depth sensor."""
    stamp_s: Float[np.ndarray, " T"]
    """Times in seconds, not decreasing."""
    cam_from_world: Float[np.ndarray, "T 4 4"]
    """Pose per frame; identities if unknown."""
    notes: tuple[str, ...] = ()
    """What is less than it could be, in words, such as a camera that was guessed."""

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

    @classmethod
    def from_arrays(
        cls,
        rgb: Any,
        depth_m: Any = None,
        camera: Any = None,
        *,
        stamp_s: Any = None,
        cam_from_world: Any = None,
        fps: float | int | None = None,
        fov_deg: float | int | None = None,
        name: str = "clip",
    ) -> Clip:
        """A clip from arrays in memory, checked as a recording on disk is.

        Arrays may be those of NumPy, tensors of PyTorch on any device, or lists of frames.

        Args:
            rgb: colours, [T, H, W, 3], as uint8 or as floats from 0 to 1.
            depth_m: depth along +z in metres, [T, H, W]; what is not finite or not positive counts as missing. None
                without a depth sensor.
            camera: intrinsics as a :class:`Camera`, or the 3 x 3 matrix that OpenCV and ROS give. None makes one from
                ``fov_deg``, or guesses (see :meth:`Camera.from_fov`) and says so in ``notes``.
            stamp_s: times in seconds, [T], not decreasing; by default frames follow each other at ``fps``.
            cam_from_world: pose per frame, [T, 4, 4], or [4, 4] for a camera that stands still; identities by default,
                which make the camera the world.
            fps: frames per second, where there are no times; 30 by default.
            fov_deg: field of view along the longer side in degrees, where there is no camera.
            name: what to call the clip in files and tables.

        Raises:
            InputError: shapes or types are not as expected or contradict each other, times decrease, or there are no
                frames; as RecordingError if the depth is in the wrong units (millimetres, say).
        """
        what = f"clip {name!r}"
        colours = _colours(_array(rgb, f"{what}: colours"), what)
        t, h, w = colours.shape[:3]
        if stamp_s is not None and fps is not None:
            raise InputError(f"{what}: times come from stamp_s or from fps, not from both; give one of them")
        fps = _FRAMES_PER_S if fps is None else fps
        if not 0 < fps < np.inf:
            raise InputError(f"{what}: expected fps > 0, got {fps}")
        stamps = np.arange(t) / fps if stamp_s is None else _array(stamp_s, f"{what}: stamp_s").astype(np.float64)
        poses = np.eye(4) if cam_from_world is None else _array(cam_from_world, f"{what}: cam_from_world")
        poses = np.array(np.broadcast_to(poses, (t, 4, 4)) if poses.shape == (4, 4) else poses, dtype=np.float64)
        depth = None if depth_m is None else _array(depth_m, f"{what}: depth")
        if depth is not None and depth.shape != (t, h, w):
            raise InputError(f"{what}: expected depth of shape {(t, h, w)}, as the colours, got {depth.shape}")
        depth = None if depth is None else clean_depth(depth)
        notes = (GUESSED_CAMERA,) if camera is None and fov_deg is None else ()
        clip = cls(name, _camera(camera, w, h, fov_deg, what), colours, depth, stamps, poses, notes)
        if depth is not None:
            check_units(depth, what, 1.0)
        return clip

    def __len__(self) -> int:
        return len(self.rgb)

    def __repr__(self) -> str:
        length_s = float(self.stamp_s[-1] - self.stamp_s[0])
        depth = "no depth" if self.depth_m is None else "depth"
        moves = "camera moves" if (self.cam_from_world != self.cam_from_world[0]).any() else "camera stands still"
        size = f"{self.camera.width} x {self.camera.height} px"
        notes = "".join(f"; {note}" for note in self.notes)
        return f"Clip({self.name!r}, {len(self)} frames of {size}, {length_s:.2f} s, {depth}, {moves}{notes})"

    def frame(self, t: int) -> Frame:
        """Frame ``t``."""
        depth = None if self.depth_m is None else self.depth_m[t]
        return Frame(self.rgb[t], depth, float(self.stamp_s[t]), self.cam_from_world[t])


def _array(values: Any, what: str) -> np.ndarray:
    """An array from what a caller has: an array, a tensor on any device, or a list of frames."""
    try:
        # A tensor is told by this method, because this module does without PyTorch.
        return np.asarray(values.detach().cpu().numpy() if hasattr(values, "detach") else values)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} cannot be read as one array ({error}); give NumPy arrays or tensors") from error


def _colours(rgb: np.ndarray, what: str) -> UInt8[np.ndarray, "T H W 3"]:
    """Colours of uint8, from these or from floats in [0, 1]."""
    advice = "give them as [T, H, W, 3]"
    if rgb.ndim == 3:
        one = rgb.shape[2] == 3
        advice = "this looks like one frame: rgb[None]" if one else "this looks grey: np.stack([grey] * 3, axis=-1)"
    elif rgb.ndim == 4 and rgb.shape[3] == 4:
        advice = "leave the alpha channel out: rgb[..., :3]"
    elif rgb.ndim == 4 and rgb.shape[1] == 3:
        advice = "the channels come second: rgb.transpose(0, 2, 3, 1), or rgb.permute(0, 2, 3, 1) of a tensor"
    if rgb.ndim != 4 or rgb.shape[3] != 3:
        raise InputError(f"{what}: expected colours of shape [T, H, W, 3], got {list(rgb.shape)}; {advice}")
    if rgb.dtype.kind == "f" and rgb.size:
        low, high = float(rgb.min()), float(rgb.max())
        if not (low >= 0 and high <= 1):  # also where one is NaN
            raise InputError(
                f"{what}: expected colours of uint8, or floats from 0 to 1, got floats from {low:.3g} to {high:.3g}; "
                "for 0 to 255 convert them: rgb.astype(np.uint8)"
            )
        rgb = np.rint(rgb * 255).astype(np.uint8)
    elif rgb.dtype != np.uint8:
        raise InputError(f"{what}: expected colours of uint8, or floats from 0 to 1, got {rgb.dtype}; convert them")
    return np.ascontiguousarray(rgb)


def _camera(camera: Any, width: int, height: int, fov_deg: float | int | None, what: str) -> Camera:
    """A camera, from intrinsics, a matrix, a field of view, or nothing."""
    if camera is not None and fov_deg is not None:
        raise InputError(f"{what}: the field of view comes from camera or from fov_deg; give one of them")
    if camera is None:
        return Camera.from_fov(width, height, fov_deg)
    if isinstance(camera, Camera):
        return camera
    matrix = _array(camera, f"{what}: camera")
    if matrix.shape != (3, 3):
        raise InputError(f"{what}: expected a quest.Camera or a 3 x 3 matrix, got shape {list(matrix.shape)}")
    return Camera.from_opencv(matrix.astype(np.float64), width=width, height=height)


@dataclass(frozen=True)
class Query:
    """What the user asks to follow.

    Use :meth:`slot`, :meth:`semantic`, :meth:`text`, :meth:`point`, or :meth:`box` and :meth:`mask`, which make points.
    """

    kind: Literal["slot", "semantic", "text", "point"]
    """``slot`` (discover anything), ``semantic`` (a label), ``text`` (words), ``point`` (a pixel in a frame)."""
    name: str = ""
    """How to call the answer; made up from the kind where empty."""
    label: str | None = None
    """One of :data:`LABELS`, or None if unknown."""
    frame: int = 0
    """Frame index of a point query."""
    uv_px: tuple[float, float] | None = None
    """Pixel of a point query, in the source image."""
    intent: str | None = None
    """One of :data:`INTENTS`, or None for either."""
    words: str | None = None
    """What a text query says."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise InputError(f"query: expected a name as text, got {self.name!r}")
        for what, said, known in (("label", self.label, LABELS), ("intent", self.intent, INTENTS)):
            if said is not None and said not in known:
                raise InputError(f"query: {what} {said!r} is unknown; expected one of {', '.join(known)}")
        if (self.kind == "point") != (self.uv_px is not None):
            raise InputError("query: a point query needs a pixel, the other kinds take none")
        if (self.kind == "text") != (self.words is not None):
            raise InputError("query: a text query needs words, the other kinds take none")
        if self.uv_px is not None and not np.isfinite(self.uv_px).all():
            raise InputError(f"query: expected a finite pixel (x, y), got {self.uv_px}")
        if self.frame < 0:
            raise InputError(f"query: expected a frame index >= 0, got {self.frame}")

    def __repr__(self) -> str:
        words = {"name": self.name, "label": self.label, "intent": self.intent}
        given = [f"{key}={value!r}" for key, value in words.items() if value]
        if self.uv_px is not None:
            given = [str(self.frame), *(f"{value:g}" for value in self.uv_px), *given]
        if self.words is not None:
            given = [repr(self.words), *(text for text in given if text != f"name={self.words!r}")]
        return f"Query.{self.kind}({', '.join(given)})"

    @classmethod
    def slot(cls, name: str = "") -> Query:
        """Follow whatever entity the network discovers."""
        return cls("slot", name)

    @classmethod
    def semantic(cls, label: str, name: str = "", *, intent: str | None = None) -> Query:
        """Follow the most confident entity of a label, and of an intent if one is given."""
        return cls("semantic", name, label, intent=intent)

    @classmethod
    def text(cls, words: str, name: str = "") -> Query:
        """Follow the one thing that a text such as "the lever of the left door" means (:mod:`quest.text`)."""
        return cls("text", name or words, words=words)

    @classmethod
    def point(cls, frame: int, x: float, y: float, *, name: str = "", label: str | None = None) -> Query:
        """Follow the entity at pixel ``(x, y)`` of frame ``frame``."""
        return cls("point", name, label, frame, (x, y))

    @classmethod
    def box(
        cls,
        frame: int,
        x_min: float,
        y_min: float,
        x_max: float,
        y_max: float,
        *,
        name: str = "",
        label: str | None = None,
    ) -> Query:
        """Follow what a box of a detector holds, in pixels of frame ``frame``: the entity at its centre.

        Raises:
            InputError: the box is not finite, or has no area.
        """
        corners = (x_min, y_min, x_max, y_max)
        if not (np.isfinite(corners).all() and x_min < x_max and y_min < y_max):
            raise InputError(f"query {name!r}: expected a box (x_min, y_min, x_max, y_max) with an area, got {corners}")
        return cls.point(frame, (x_min + x_max) / 2, (y_min + y_max) / 2, name=name, label=label)

    @classmethod
    def mask(cls, frame: int, mask: Any, *, name: str = "", label: str | None = None) -> Query:
        """Follow what a mask of a segmenter shows in frame ``frame``: the entity at its pixel nearest to its centroid.

        Args:
            frame: index of the frame.
            mask: [H, W] of the frame's size, true or positive where the entity is; an array or a tensor.
            name: what to call it.
            label: one of :data:`LABELS`, if known.

        Raises:
            InputError: the mask is no picture, or is empty.
        """
        shown = _array(mask, f"query {name!r}: mask")
        if shown.ndim != 2 or not (shown > 0).any():
            raise InputError(
                f"query {name!r}: expected a mask [H, W] with at least one pixel, got shape {list(shown.shape)} with "
                f"{int((shown > 0).sum())}"
            )
        row_column = np.argwhere(shown > 0)
        apart = np.linalg.norm(row_column - row_column.mean(axis=0), axis=1)
        row, column = row_column[apart.argmin()].tolist()
        return cls.point(frame, column + 0.5, row + 0.5, name=name, label=label)


@dataclass(frozen=True)
class Joint:
    """A joint of a simulated object."""

    name: str
    """Name in the URDF."""
    kind: Literal["revolute", "prismatic"]
    """``revolute`` or ``prismatic``."""
    lower: float
    """Lower limit of the model, radians or metres."""
    upper: float
    """Upper limit of the model, radians or metres; scripts open a hinge by at most 110 degrees."""


@dataclass(frozen=True)
class Entity:
    """A physical point on one link that can be followed."""

    name: str
    """Unique within the object, such as ``link_0/handle``."""
    label: str
    """One of :data:`LABELS`, or ``hinge`` (reported apart, never scored)."""
    link: int
    """Index of its link in the take's link arrays; 0 is the base, which never moves."""
    joint: int
    """Index of its joint in the take's joint arrays; -1 if it is fixed in the base (see :attr:`fixed`)."""

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
    """Where a take comes from and what is in it."""

    name: str
    """Unique in its store."""
    source: Literal["partnet-mobility", "sweethome3d", "procedural", "own"]
    """``sweethome3d`` is an imported object that is in the object split, ``own`` any other of a user."""
    object_id: str
    """Folder name, or ``category-seed`` of a procedural object."""
    category: str
    """Such as ``StorageFurniture``."""
    level: int
    """How many joints move one after the other."""
    seed: int
    """Seed of everything random in the take."""
    half_diagonal_m: float
    """Half the diagonal of the object's bounding box at rest, the unit of normalised distances."""
    frames_per_s: float
    """Frame rate that the time stamps follow."""
    entities: tuple[Entity, ...]
    """What can be followed; hinges last."""
    joints: tuple[Joint, ...]
    """Moving joints."""
    moved_joints: tuple[int, ...]
    """The joints that move in this take, in order, as indices into ``joints``."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Commit, versions of the packages that made the data, renderer, command."""
    suite: str = "standard"
    """Which of the simulator's suites it belongs to; ``standard`` is none."""


@dataclass(frozen=True)
class View:
    """One camera's frames of a take with their ground truth (a :class:`Clip` and what is true of it)."""

    clip: Clip
    """The frames."""
    uv_px: Float32[np.ndarray, "T E 2"]
    """True pixel per entity, also where occluded or outside the image; NaN behind the camera."""
    visible: Bool[np.ndarray, "T E"]
    """Whether the entity is seen."""
    link_id: UInt8[np.ndarray, "T H W"]
    """0 background, else 1 + link index."""
    entity_id: UInt8[np.ndarray, "T H W"]
    """Affordance mask: 0 nothing, else 1 + entity index."""


@dataclass(frozen=True)
class Take:
    """One event seen by V views, with ground truth in the world frame."""

    info: TakeInfo
    """Description."""
    views: tuple[View, ...]
    """One per camera."""
    stamp_s: Float[np.ndarray, " T"]
    """Times, shared by all views."""
    point_world: Float32[np.ndarray, "T E 3"]
    """True world point per entity."""
    flow_world: Float32[np.ndarray, "T E 3"]
    """Displacement of each entity to the next frame; 0 at the last."""
    link_pose: Float32[np.ndarray, "T L 4 4"]
    """``world_from_link`` per link."""
    joint_position: Float32[np.ndarray, "T J"]
    """Radians or metres."""
    joint_velocity: Float32[np.ndarray, "T J"]
    """Per second."""
    joint_axis: Float32[np.ndarray, "T J 6"]
    """Origin and unit direction of each joint's axis in the world."""

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
