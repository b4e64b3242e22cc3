"""Tracks on disk: Parquet, one row per frame and query, readable by any table tool."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from quest.errors import InputError
from quest.types import Joints, State, Tracks
from quest.whole_file import whole_file

VERSION = 2
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
    ]
)
"""Columns: pixels in the source image, metres in the world frame; null where there is no position, and where a tracker
does not say how probably it is lost or whether it alarms."""


def write_tracks(tracks: Tracks, path: str | Path) -> None:
    """Write tracks as Parquet, all or nothing; an existing file is replaced.

    Rows are ordered by frame, then query. Names, labels, time stamps, frame flags and joints are in the metadata, so
    that tracks without queries come back whole.
    """
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
    with whole_file(Path(path)) as partial, partial.open("wb") as file:  # not by its path, which may be no UTF-8
        pq.write_table(pa.Table.from_arrays(arrays, schema=schema), file, compression="zstd")


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
        joints=None if metadata["joints"] is None else _joints_from_json(metadata["joints"]),
    )


def _joints_to_json(joints: Joints) -> list[dict]:
    """One entry per query; JSON has no NaN."""
    rows = zip(joints.kind, joints.axis, joints.origin, strict=True)
    return [{"kind": k, "axis": _finite(a), "origin_m": _finite(o)} for k, a, o in rows]


def _finite(vector: np.ndarray) -> list[float] | None:
    return [float(v) for v in vector] if np.isfinite(vector).all() else None


def _joints_from_json(rows: list[dict]) -> Joints:
    def stacked(name: str) -> np.ndarray:
        return np.array([row[name] or [np.nan] * 3 for row in rows], np.float32).reshape(len(rows), 3)

    return Joints(tuple(row["kind"] for row in rows), stacked("axis"), stacked("origin_m"))
