"""Tracks on disk: Parquet, one row per frame and query, readable by any table tool; joints also as JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from quest.errors import InputError
from quest.types import Joints, State, Tracks
from quest.whole_file import whole_file

VERSION = 3
JOINTS_VERSION = 1
_METADATA_KEY = b"quest-tracks"

SCHEMA = pa.schema(
    [
        ("frame", pa.int32()),
        ("stamp_s", pa.float64()),
        ("query", pa.int32()),
        ("name", pa.string()),
        ("label", pa.string()),
        ("x_px", pa.float32()),
        ("y_px", pa.float32()),
        ("x_m", pa.float32()),
        ("y_m", pa.float32()),
        ("z_m", pa.float32()),
        ("confidence", pa.float32()),
        ("visible", pa.bool_()),
        ("state", pa.string()),
        ("lost_p", pa.float32()),
        ("alarm", pa.bool_()),
        ("q", pa.float32()),
    ]
)
"""Columns: pixels in the source image, metres in the world frame, ``q`` on the joint in radians or metres; null where
there is none, and where a tracker does not say how probably it is lost or whether it alarms."""


def save_tracks(tracks: Tracks, path: str | Path) -> None:
    """Write tracks into a folder, as ``tracks.parquet`` and ``joints.json``, or into one file of Parquet.

    Raises:
        InputError: the path names a file of another kind.
    """
    path = Path(path)
    if path.suffix == ".parquet":
        write_tracks(tracks, path)
        return
    if path.is_file() or (path.suffix and not path.is_dir()):
        raise InputError(f"tracks {path}: expected a folder, or a file that ends in .parquet; name one of these")
    write_tracks(tracks, path / "tracks.parquet")
    if tracks.joints is not None:
        write_joints(tracks, path / "joints.json")


def write_joints(tracks: Tracks, path: str | Path) -> None:
    """Write the joints of tracks as JSON (``docs/tracker.md`` lists its fields), all or nothing.

    Raises:
        InputError: the tracks have no joints.
    """
    joints = tracks.joints
    if joints is None:
        raise InputError(f"joints {path}: these tracks have none; a tracker that is grounded in joints gives them")
    rows = [
        {"query": k, "name": tracks.names[k], "label": tracks.labels[k], **row, "q": _plain(joints.q[:, k], digits=6)}
        for k, row in enumerate(_joints_to_json(joints, digits=6))
    ]
    whole = {"version": JOINTS_VERSION, "stamp_s": [float(stamp) for stamp in tracks.stamp_s], "joints": rows}
    with whole_file(Path(path)) as partial:
        partial.write_text(json.dumps(whole, allow_nan=False) + "\n", encoding="utf-8")


def write_tracks(tracks: Tracks, path: str | Path) -> None:
    """Write tracks as Parquet, all or nothing; an existing file is replaced.

    Rows are ordered by frame, then query. Names, labels, time stamps, frame flags and joints are in the metadata, so
    that tracks without queries come back whole.
    """
    with whole_file(Path(path)) as partial, partial.open("wb") as file:  # not by its path, which may be no UTF-8
        pq.write_table(tracks_table(tracks), file, compression="zstd")


def tracks_table(tracks: Tracks) -> pa.Table:
    """Tracks as a table with the columns of :data:`SCHEMA`, one row per frame and query."""
    frames, queries = tracks.uv_px.shape[:2]
    frame, query = (index.ravel() for index in np.indices((frames, queries), dtype=np.int32))
    uv_px, point = tracks.uv_px.reshape(-1, 2), tracks.point_world.reshape(-1, 3)
    columns = {
        "frame": frame,
        "stamp_s": np.asarray(tracks.stamp_s, dtype=np.float64)[frame],
        "query": query,
        "name": [tracks.names[k] for k in query],
        "label": [tracks.labels[k] for k in query],
        "x_px": uv_px[:, 0],
        "y_px": uv_px[:, 1],
        "x_m": point[:, 0],
        "y_m": point[:, 1],
        "z_m": point[:, 2],
        "confidence": tracks.confidence.ravel(),
        "visible": tracks.visible.ravel(),
        "state": [str(state) for state in tracks.state.ravel()],
        "lost_p": [None] * len(frame) if tracks.lost_p is None else tracks.lost_p.ravel(),
        "alarm": [None] * len(frame) if tracks.alarm is None else tracks.alarm.ravel(),
        "q": [None] * len(frame) if tracks.joints is None else tracks.joints.q.ravel(),
    }
    arrays = [pa.array(columns[field.name], type=field.type, from_pandas=True) for field in SCHEMA]
    metadata = {
        "version": VERSION,
        "names": tracks.names,
        "labels": tracks.labels,
        "stamp_s": [float(stamp) for stamp in tracks.stamp_s],
        "frame_flags": tracks.frame_flags,
        "watched": tracks.lost_p is not None,
        "joints": None if tracks.joints is None else _joints_to_json(tracks.joints),
    }
    schema = SCHEMA.with_metadata({_METADATA_KEY: json.dumps(metadata).encode()})
    return pa.Table.from_arrays(arrays, schema=schema)


def read_tracks(path: str | Path) -> Tracks:
    """Read tracks written by :func:`write_tracks`.

    Raises:
        InputError: the file is missing, torn, not a table of tracks, or of another format version.
    """
    try:
        with Path(path).open("rb") as file:
            table = pq.read_table(file)
    except FileNotFoundError:
        raise InputError(f"tracks {path}: no such file; check the path, or run quest track") from None
    except (pa.ArrowException, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"tracks {path}: cannot be read as Parquet ({reason}); the file is torn, track again"
        ) from error
    raw = (table.schema.metadata or {}).get(_METADATA_KEY)
    if raw is None or table.schema.names != SCHEMA.names:
        raise InputError(
            f"tracks {path}: a Parquet file, but not of tracks (columns {', '.join(table.schema.names)}); "
            "give a file that quest track wrote"
        )
    metadata = json.loads(raw)
    if metadata.get("version") != VERSION:
        raise InputError(
            f"tracks {path}: format version {metadata.get('version')}, expected {VERSION}; track again, or use the "
            "version of quest that wrote it"
        )
    frames, queries = len(metadata["stamp_s"]), len(metadata["names"])
    if table.num_rows != frames * queries:
        raise InputError(f"tracks {path}: {table.num_rows} rows for {frames} frames of {queries} queries; track again")

    def column(name: str) -> np.ndarray:
        return table[name].to_numpy().reshape(frames, queries)

    def stacked(*names: str) -> np.ndarray:
        return np.stack([column(name) for name in names], axis=-1).astype(np.float32)

    return Tracks(
        names=tuple(metadata["names"]),
        labels=tuple(metadata["labels"]),
        uv_px=stacked("x_px", "y_px"),
        point_world=stacked("x_m", "y_m", "z_m"),
        confidence=column("confidence").astype(np.float32),
        visible=column("visible").astype(bool),
        state=np.array([State(state).value for state in table["state"].to_pylist()], dtype="<U8").reshape(
            frames, queries
        ),
        stamp_s=np.array(metadata["stamp_s"], dtype=np.float64),
        frame_flags=tuple(metadata["frame_flags"]),
        lost_p=column("lost_p").astype(np.float32) if metadata["watched"] else None,
        alarm=column("alarm").astype(bool) if metadata["watched"] else None,
        joints=None if metadata["joints"] is None else _joints_from_json(metadata["joints"], column("q")),
    )


def _joints_to_json(joints: Joints, *, digits: int | None = None) -> list[dict[str, Any]]:
    """One entry per query, without its coordinates."""
    return [
        {
            "kind": kind,
            "axis": _plain(joints.axis[k], digits),
            "origin_m": _plain(joints.origin[k], digits),
            "q_min_seen": _plain(joints.q_min_seen[k], digits),
            "q_max_seen": _plain(joints.q_max_seen[k], digits),
            "covariance": _plain(joints.covariance[k], digits),
        }
        for k, kind in enumerate(joints.kind)
    ]


def _plain(values: np.ndarray, digits: int | None = None) -> Any:
    """Nested lists of numbers, null where they are NaN, as JSON has none; one null where all of several are.

    Args:
        values: of any shape.
        digits: significant ones; all by default.
    """
    if values.ndim == 0:
        number = float(values) if digits is None else float(f"{values:.{digits}g}")
        return number if np.isfinite(number) else None
    return [_plain(value, digits) for value in values] if np.isfinite(values).any() or not values.size else None


def _joints_from_json(rows: list[dict[str, Any]], q: np.ndarray) -> Joints:
    joints = Joints.unknown(*q.shape)
    for k, row in enumerate(rows):
        joints.axis[k] = _numbers(row["axis"])
        joints.origin[k] = _numbers(row["origin_m"])
        joints.q_min_seen[k] = _numbers(row["q_min_seen"])
        joints.q_max_seen[k] = _numbers(row["q_max_seen"])
        if row["covariance"] is not None:
            joints.covariance[k] = [[np.nan] * 6 if line is None else _numbers(line) for line in row["covariance"]]
    return replace(joints, kind=tuple(row["kind"] for row in rows), q=q.astype(np.float32))


def _numbers(values: float | list[float | None] | None) -> np.ndarray:
    return np.array(values, np.float32)  # null becomes NaN
