"""Tracks, the answers of a tracker, with the joints that explain them; and the files that they are kept in.

A file of tracks is Parquet, one row per frame and query, readable by any table tool, with the joints in it; joints are
also written as JSON.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Float32

from quest.errors import InputError
from quest.extras import require
from quest.untrusted import build, parse_json, reading, require_table
from quest.whole_file import whole_file
from quest.wording import counted

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

VERSION = 3
JOINTS_VERSION = 1
_SHOWN = 12
_PER_FRAME = ("uv_px", "point_world", "confidence", "visible", "state", "lost_p", "alarm")
_METADATA_KEY = b"quest-tracks"
_POSES_KEY = b"quest-cam-from-world"
"""Of the camera's poses: T x 4 x 4 little-endian doubles, row by row."""

_JOINT_ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "axis": ("axis", (3,)),
    "origin_m": ("origin", (3,)),
    "q_min_seen": ("q_min_seen", ()),
    "q_max_seen": ("q_max_seen", ()),
    "covariance": ("covariance", (6, 6)),
}
"""Arrays of a joint by their names in JSON: the field of :class:`Joints`, and the shape for each query."""

COLUMNS = {
    "frame": "int32",
    "stamp_s": "double",
    "query": "int32",
    "name": "string",
    "label": "string",
    "x_px": "float",
    "y_px": "float",
    "x_m": "float",
    "y_m": "float",
    "z_m": "float",
    "confidence": "float",
    "visible": "bool",
    "state": "string",
    "lost_p": "float",
    "alarm": "bool",
    "q": "float",
}
"""Columns and their types in Arrow: pixels of the source image, metres in the world, ``q`` on the joint in radians or
metres; null where there is none, and where a tracker does not say how probably it is lost or whether it alarms."""


class State(StrEnum):
    """What a query is doing at a frame."""

    TRACKING = "tracking"
    HELD = "held"
    LOST = "lost"


@dataclass(frozen=True)
class Joints:
    """The joints that explain K tracks, as known at the end, in the world.

    The coordinate ``q`` of a joint is 0 about where its entity was seen first and grows the way it then went: radians
    about the axis (right-handed, within half a turn either way), or metres along it.
    """

    kind: tuple[str, ...]
    """``static``, ``prismatic``, ``revolute``, or ``unknown`` where nothing was seen."""
    axis: Float32[np.ndarray, "K 3"]
    """Unit direction of sliding, or of the axis of turning; NaN where there is none."""
    origin: Float32[np.ndarray, "K 3"]
    """Metres: the point of the axis of turning that is nearest to the path, a point of the path of sliding, or the
    place of what is static; NaN where unknown."""
    q_min_seen: Float32[np.ndarray, " K"]
    """Smallest coordinate that was seen; NaN without a joint that moves."""
    q_max_seen: Float32[np.ndarray, " K"]
    """Largest one; NaN likewise."""
    q: Float32[np.ndarray, "T K"]
    """Coordinate per frame; NaN likewise, and where the tracker knew no world point. Of a query that was asked for by a
    pixel, it is that of the network's own point beside it, which the same joint moves."""
    covariance: Float32[np.ndarray, "K 6 6"]
    """Of small errors of ``axis`` (3, radians) and ``origin`` (3, metres) together, in world axes. Only what is across
    the axis counts: its length is 1, and a shift along the axis of turning, or along the path of sliding, changes
    nothing, so that a moving joint's matrix has rank 4. Of a static one the part of the axis is NaN; all is NaN where
    the kind is unknown. It is the inverse of the normal equations at the end of the fit, scaled by the noise of a point
    that the tracker assumes, or by the residuals where these are larger. A wrong kind, or a point that is not of the
    entity, is not in it."""

    @classmethod
    def unknown(cls, frames: int, queries: int) -> Joints:
        """Joints of which nothing is known."""
        shapes = {"q": (frames, queries), **{name: (queries, *shape) for name, shape in _JOINT_ARRAYS.values()}}
        nothing = {name: np.full(shape, np.nan, np.float32) for name, shape in shapes.items()}
        return cls(kind=("unknown",) * queries, **nothing)

    @property
    def axis_sigma_rad(self) -> Float[np.ndarray, " K"]:
        """Standard deviation of each axis' direction about each of two perpendicular directions; NaN where none is."""
        return np.sqrt(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2).clip(0) / 2)

    @property
    def origin_sigma_m(self) -> Float[np.ndarray, " K"]:
        """Standard deviation of each origin along each direction in which a shift of it counts, metres."""
        directions = np.where(np.array(self.kind, dtype=object) == "static", 3, 2)
        return np.sqrt(np.trace(self.covariance[:, 3:, 3:], axis1=1, axis2=2).clip(0) / directions)

    def rest(
        self, point_world: Float[np.ndarray, "T K 3"], state: np.ndarray | None = None
    ) -> Float[np.ndarray, "K 3"]:
        """Where each entity is at q = 0, metres: the median of its points, each taken back by its q.

        Args:
            point_world: of the tracks that the joints explain.
            state: theirs; points of lost ones are left out, but where there are no others.

        Returns:
            NaN where the joint is unknown.
        """
        from scipy.spatial.transform import Rotation

        found = np.full((len(self), 3), np.nan)
        for k, kind in enumerate(self.kind):
            points, q = point_world[:, k].astype(np.float64), self.q[:, k].astype(np.float64)
            known = np.isfinite(points).all(axis=-1) & (np.isfinite(q) | (kind == "static"))
            sure = known if state is None else known & (state[:, k] != State.LOST)
            which = sure if sure.any() else known
            if kind == "unknown" or not which.any():
                continue
            points, q, axis, origin = points[which], q[which, None], self.axis[k], self.origin[k]
            if kind == "prismatic":
                points = points - q * axis
            elif kind == "revolute":
                points = origin + Rotation.from_rotvec(-q * axis).apply(points - origin)
            found[k] = np.median(points, axis=0)
        return found

    def __len__(self) -> int:
        return len(self.kind)

    def __repr__(self) -> str:
        return f"Joints({', '.join(self.describe(k) for k in range(len(self)))})"

    def describe(self, k: int, t: int | None = None) -> str:
        """The joint of query ``k`` in a few words, and where on it the entity is in frame ``t`` if one is given."""
        q = None if t is None else float(self.q[t, k])
        return describe_joint(self.kind[k], float(self.q_min_seen[k]), float(self.q_max_seen[k]), q=q)

    def select(self, queries: np.ndarray) -> Joints:
        """The joints of some queries only."""
        each = {name: value[queries] for name, value in vars(self).items() if name not in ("kind", "q")}
        return Joints(kind=tuple(self.kind[i] for i in queries), q=self.q[:, queries], **each)


def describe_joint(kind: str, q_min_seen: float, q_max_seen: float, *, q: float | None = None) -> str:
    """Kind of a joint and the range that was seen, in degrees or metres: ``revolute 0 to 34 deg``.

    Args:
        kind: as in :class:`Joints`.
        q_min_seen: radians or metres.
        q_max_seen: radians or metres.
        q: where on it something is, which then comes first, with the range in brackets; NaN is ``?``.
    """
    if kind not in ("prismatic", "revolute"):
        return kind
    factor, digits, unit = (180 / np.pi, 0, "deg") if kind == "revolute" else (1.0, 2, "m")
    seen = f"{factor * q_min_seen:z.{digits}f} to {factor * q_max_seen:z.{digits}f}"
    if q is None:
        return f"{kind} {seen} {unit}"
    now = f"{factor * q:z.{digits}f}" if np.isfinite(q) else "?"
    return f"{kind} {now} {unit} ({seen})"


@dataclass(frozen=True)
class Tracks:
    """Answers to K queries over T frames."""

    names: tuple[str, ...]
    """Name per query."""
    labels: tuple[str | None, ...]
    """Label per query, or None."""
    uv_px: Float32[np.ndarray, "T K 2"]
    """Pixel in the source image; NaN before a query is bound."""
    point_world: Float32[np.ndarray, "T K 3"]
    """World point in metres; NaN before binding and where it cannot be lifted."""
    confidence: Float32[np.ndarray, "T K"]
    """Probability that the identity is still right, 0 before binding."""
    visible: Bool[np.ndarray, "T K"]
    """Whether the entity is seen."""
    state: np.ndarray
    """:class:`State` value per frame and query."""
    stamp_s: Float[np.ndarray, " T"]
    """Times in seconds."""
    frame_flags: tuple[str, ...] = ()
    """Degradations of whole frames or of the whole clip, in words."""
    lost_p: Float32[np.ndarray, "T K"] | None = None
    """Calibrated probability that the identity is lost, NaN where unknown; None without a monitor."""
    alarm: Bool[np.ndarray, "T K"] | None = None
    """Whether an alarm is open; None likewise."""
    joints: Joints | None = None
    """What explains the tracks at the end; None of trackers that tell of none."""
    cam_from_world: Float[np.ndarray, "T 4 4"] | None = None
    """The camera's pose in the world of the points, as it was given or estimated; NaN in frames in which it was
    unknown, None where it always was."""

    def __len__(self) -> int:
        return len(self.uv_px)

    def __repr__(self) -> str:
        k = len(self.names)
        lines = [f"Tracks({len(self)} frames, {counted(k, 'query', 'queries')})"]
        lines += [f"  {self.describe(i)}" for i in range(min(k, _SHOWN))]
        return "\n".join(lines if k <= _SHOWN else [*lines, f"  and {k - _SHOWN} more"])

    def describe(self, k: int) -> str:
        """The track of query ``k`` in one line: its name, how often it was seen, its joint and its state at the end."""
        found = np.isfinite(self.uv_px[:, k]).all(axis=-1)
        if not found.any():
            return f"{self.names[k]}: not found"
        joint = "" if self.joints is None else f", {self.joints.describe(k)}"
        seen = f"seen in {self.visible[found, k].mean():.0%} of {found.sum()} frames"
        return f"{self.names[k]}: {seen}{joint}, {self.state[-1, k]} at the end"

    def save(self, path: str | Path) -> None:
        """Write the tracks; what is there already is replaced.

        Args:
            path: a folder, which gets ``tracks.parquet`` and, with joints, ``joints.json``; or a file that ends in
                ``.parquet``, which gets all in one table.

        Raises:
            InputError: the path names a file of another kind.
        """
        path = Path(path)
        if path.suffix == ".parquet":
            write_tracks(self, path)
            return
        if path.is_file() or (path.suffix and not path.is_dir()):
            raise InputError(f"tracks {path}: expected a folder, or a file that ends in .parquet; name one of these")
        write_tracks(self, path / "tracks.parquet")
        if self.joints is not None:
            write_joints(self, path / "joints.json")

    def to_pandas(self) -> pd.DataFrame:
        """One row per frame and query, with the columns of ``tracks.parquet``; NaN or None where nothing is known.

        Raises:
            MissingExtraError: the extra ``pandas`` is not installed.
        """
        require("pandas")
        return tracks_table(self).to_pandas()

    def select(self, queries: list[int] | np.ndarray) -> Tracks:
        """The same tracks of some queries only."""
        index = np.asarray(queries, dtype=int)
        known = {name: value for name in _PER_FRAME if (value := getattr(self, name)) is not None}
        return replace(
            self,
            names=tuple(self.names[i] for i in index),
            labels=tuple(self.labels[i] for i in index),
            joints=None if self.joints is None else self.joints.select(index),
            **{name: value[:, index] for name, value in known.items()},
        )


def write_joints(tracks: Tracks, path: str | Path) -> None:
    """Write the joints of tracks as JSON (``docs/tracker.md`` lists its fields), all or nothing.

    Raises:
        InputError: the tracks have no joints.
    """
    joints = tracks.joints
    if joints is None:
        raise InputError(f"joints {path}: these tracks have none; quest gives them")
    rest = joints.rest(tracks.point_world, tracks.state)
    rows = [
        {"query": k, "name": tracks.names[k], "label": tracks.labels[k], **row}
        | {
            "rest_m": _plain(rest[k], digits=6),
            "axis_sigma_rad": _plain(joints.axis_sigma_rad[k], digits=3),
            "origin_sigma_m": _plain(joints.origin_sigma_m[k], digits=3),
            "q": _plain(joints.q[:, k], digits=6),
        }
        for k, row in enumerate(_joints_to_json(joints, digits=6))
    ]
    whole = {
        "version": JOINTS_VERSION,
        "frame": "world of the camera's poses; without poses the first camera: x right, y down, z forward",
        "units": {"length": "m", "angle": "rad", "time": "s"},
        "stamp_s": [float(stamp) for stamp in tracks.stamp_s],
        "joints": rows,
    }
    with whole_file(Path(path)) as partial:
        partial.write_text(json.dumps(whole, allow_nan=False) + "\n", encoding="utf-8")


def write_tracks(tracks: Tracks, path: str | Path) -> None:
    """Write tracks as Parquet, all or nothing; an existing file is replaced.

    Rows are ordered by frame, then query. Names, labels, time stamps, frame flags and joints are in the metadata, so
    that tracks without queries come back whole.
    """
    import pyarrow.parquet as pq

    with whole_file(Path(path)) as partial, partial.open("wb") as file:  # not by its path, which may be no UTF-8
        pq.write_table(tracks_table(tracks), file, compression="zstd", write_page_checksum=True)


def tracks_table(tracks: Tracks) -> pa.Table:
    """Tracks as a table with the columns of :data:`COLUMNS`, one row per frame and query."""
    import pyarrow as pa

    frames, queries = tracks.uv_px.shape[:2]
    frame, query = (index.ravel() for index in np.indices((frames, queries), dtype=np.int32))

    def flat(values: np.ndarray | None) -> Any:
        return [None] * len(frame) if values is None else values.ravel()

    columns = (
        frame,
        np.asarray(tracks.stamp_s, dtype=np.float64)[frame],
        query,
        [tracks.names[k] for k in query],
        [tracks.labels[k] for k in query],
        *tracks.uv_px.reshape(-1, 2).T,
        *tracks.point_world.reshape(-1, 3).T,
        *map(flat, (tracks.confidence, tracks.visible)),
        [str(state) for state in tracks.state.ravel()],
        *map(flat, (tracks.lost_p, tracks.alarm, None if tracks.joints is None else tracks.joints.q)),
    )
    schema = pa.schema(list(COLUMNS.items()))
    arrays = [
        pa.array(values, type=field.type, from_pandas=True) for values, field in zip(columns, schema, strict=True)
    ]
    poses = tracks.cam_from_world
    extra = {} if poses is None else {_POSES_KEY: np.ascontiguousarray(poses, "<f8").tobytes()}
    metadata = {
        "version": VERSION,
        "names": tracks.names,
        "labels": tracks.labels,
        "stamp_s": [float(stamp) for stamp in tracks.stamp_s],
        "frame_flags": tracks.frame_flags,
        "watched": tracks.lost_p is not None,
        "joints": None if tracks.joints is None else _joints_to_json(tracks.joints),
    }
    kept = {_METADATA_KEY: json.dumps(metadata).encode(), **extra}
    return pa.Table.from_arrays(arrays, schema=schema.with_metadata(kept))


def read_tracks(path: str | Path) -> Tracks:
    """Read tracks written by :func:`write_tracks`.

    Raises:
        InputError: the file is missing, torn, not a table of tracks, or of another format version.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not Path(path).exists():
        raise InputError(f"tracks {path}: no such file; check the path, or run quest track")
    require_table(Path(path), InputError)
    with reading(f"tracks {path}", InputError, "the file is torn, track again"):
        table = pq.read_table(Path(path), page_checksum_verification=True)
    raw = (table.schema.metadata or {}).get(_METADATA_KEY)
    if raw is None or table.schema.names != list(COLUMNS):
        raise InputError(
            f"tracks {path}: a Parquet file, but not of tracks (columns {', '.join(table.schema.names)}); "
            "give a file that quest track wrote"
        )
    metadata = parse_json(raw, f"tracks {path}", InputError)
    if not isinstance(metadata, dict) or metadata.get("version") != VERSION:
        version = metadata.get("version") if isinstance(metadata, dict) else None
        raise InputError(
            f"tracks {path}: format version {version}, expected {VERSION}; track again, or use the version of quest "
            "that wrote it"
        )
    with reading(f"tracks {path}", InputError, "track again"):
        tracks = _tracks_of(table.cast(pa.schema(list(COLUMNS.items()))), metadata)
        poses = (table.schema.metadata or {}).get(_POSES_KEY)
        if poses is None:
            return tracks
        return replace(tracks, cam_from_world=np.frombuffer(poses, "<f8").astype(np.float64).reshape(len(tracks), 4, 4))


def _tracks_of(table: pa.Table, metadata: dict[str, Any]) -> Tracks:
    """Tracks from their table and what is written beside it."""
    stamp_s = np.array(build(list[float], metadata["stamp_s"], "stamp_s"), dtype=np.float64)
    names = build(tuple[str, ...], metadata["names"], "names")
    labels = build(tuple[str | None, ...], metadata["labels"], "labels")
    watched = build(bool, metadata["watched"], "watched")
    joints = build(list[dict] | None, metadata["joints"], "joints")
    frames, queries = len(stamp_s), len(names)
    if table.num_rows != frames * queries:
        raise ValueError(f"{table.num_rows} rows for {frames} frames of {queries} queries")

    def column(name: str) -> np.ndarray:
        return table[name].to_numpy().reshape(frames, queries)

    def flags(name: str) -> np.ndarray:
        if table[name].null_count:
            raise ValueError(f"{name} is missing in {table[name].null_count} rows")
        return column(name).astype(bool)

    def stacked(*names: str) -> np.ndarray:
        return np.stack([column(name) for name in names], axis=-1).astype(np.float32)

    states = [State(state).value for state in table["state"].to_pylist()]
    return Tracks(
        names=names,
        labels=labels,
        uv_px=stacked("x_px", "y_px"),
        point_world=stacked("x_m", "y_m", "z_m"),
        confidence=column("confidence").astype(np.float32),
        visible=flags("visible"),
        state=np.array(states, dtype="<U8").reshape(frames, queries),
        stamp_s=stamp_s,
        frame_flags=build(tuple[str, ...], metadata["frame_flags"], "frame_flags"),
        lost_p=column("lost_p").astype(np.float32) if watched else None,
        alarm=flags("alarm") if watched else None,
        joints=None if joints is None else _joints_from_json(joints, column("q")),
    )


def _joints_to_json(joints: Joints, *, digits: int | None = None) -> list[dict[str, Any]]:
    """One entry per query, without its coordinates."""
    return [
        {"kind": kind} | {key: _plain(getattr(joints, name)[k], digits) for key, (name, _) in _JOINT_ARRAYS.items()}
        for k, kind in enumerate(joints.kind)
    ]


def _joints_from_json(rows: list[dict[str, Any]], q: np.ndarray) -> Joints:
    arrays = {
        name: np.array([_numbers(row[key], shape) for row in rows]).reshape(q.shape[1], *shape).astype(np.float32)
        for key, (name, shape) in _JOINT_ARRAYS.items()
    }
    return Joints(kind=tuple(row["kind"] for row in rows), q=q.astype(np.float32), **arrays)


def _plain(values: np.ndarray | np.generic, digits: int | None = None) -> Any:
    """Nested lists of numbers, null where they are NaN, as JSON has none; one null where all of several are."""
    if values.ndim == 0:
        number = float(values) if digits is None else float(f"{values:.{digits}g}")
        return number if np.isfinite(number) else None
    if values.size and not np.isfinite(values).any():
        return None
    return [_plain(value, digits) for value in np.asarray(values)]


def _numbers(values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The inverse of :func:`_plain`."""
    if values is None:
        return np.full(shape, np.nan)
    return np.array([_numbers(value, shape[1:]) for value in values] if shape else float(values))
