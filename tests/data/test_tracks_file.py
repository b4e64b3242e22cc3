"""Tracks as Parquet: round trip, readable columns, and typed errors for what is not a file of tracks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from quest.data.tracks_file import SCHEMA, read_tracks, write_tracks
from quest.errors import InputError
from quest.types import Joints, State, Tracks


@pytest.fixture
def tracks() -> Tracks:
    rng = np.random.default_rng(0)
    uv_px, point = rng.normal(size=(5, 3, 2)), rng.normal(size=(5, 3, 3))
    uv_px[:2, 1], point[:2, 1], point[3, 0] = np.nan, np.nan, np.nan
    return Tracks(
        names=("link_0/handle", "slot-1", ""),
        labels=("handle", None, "rim"),
        uv_px=uv_px.astype(np.float32),
        point_world=point.astype(np.float32),
        confidence=rng.uniform(size=(5, 3)).astype(np.float32),
        visible=rng.uniform(size=(5, 3)) > 0.5,
        state=rng.choice([state.value for state in State], size=(5, 3)),
        stamp_s=np.array([0.0, 0.1, 0.25, 0.3, 1e9 + 0.123456]),
        frame_flags=("no depth", "größer"),
        lost_p=np.where(np.arange(3) == 1, np.nan, rng.uniform(size=(5, 3))).astype(np.float32),
        alarm=rng.uniform(size=(5, 3)) > 0.5,
        joints=Joints(
            kind=("revolute", "static", "unknown"),
            axis=np.array([[0, 0, 1], [np.nan] * 3, [np.nan] * 3], np.float32),
            origin=np.array([[0.1, 2, 3], [1, 1, 1], [np.nan] * 3], np.float32),
        ),
    )


def assert_same(found: Tracks, expected: Tracks) -> None:
    assert (found.names, found.labels, found.frame_flags) == (expected.names, expected.labels, expected.frame_flags)
    for name in ("uv_px", "point_world", "confidence", "visible", "state", "stamp_s", "lost_p", "alarm"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        assert np.shape(getattr(found, name)) == np.shape(getattr(expected, name))
    assert (found.joints is None) == (expected.joints is None)
    if found.joints is not None and expected.joints is not None:
        assert found.joints.kind == expected.joints.kind
        np.testing.assert_array_equal(found.joints.axis, expected.joints.axis)
        np.testing.assert_array_equal(found.joints.origin, expected.joints.origin)


def test_tracks_come_back(tracks: Tracks, tmp_path: Path):
    write_tracks(tracks, tmp_path / "out" / "tracks.parquet")
    found = read_tracks(tmp_path / "out" / "tracks.parquet")
    assert_same(found, tracks)
    assert (found.state == State.HELD).sum() == (tracks.state == State.HELD).sum()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["tracks.parquet"]


def test_tracks_of_trackers_that_do_not_watch_themselves(tracks: Tracks, tmp_path: Path):
    plain = replace(tracks, lost_p=None, alarm=None, joints=None)
    write_tracks(plain, tmp_path / "tracks.parquet")
    assert_same(read_tracks(tmp_path / "tracks.parquet"), plain)


def test_columns_that_other_programs_read(tracks: Tracks, tmp_path: Path):
    write_tracks(tracks, tmp_path / "tracks.parquet")
    table = pq.read_table(tmp_path / "tracks.parquet")
    assert table.schema.names == SCHEMA.names
    rows = table.to_pylist()
    assert len(rows) == 15
    assert (rows[4]["frame"], rows[4]["query"], rows[4]["name"], rows[4]["label"]) == (1, 1, "slot-1", None)
    assert rows[4]["x_px"] is None
    assert rows[4]["z_m"] is None
    assert rows[3]["y_m"] == tracks.point_world[1, 0, 1]


@pytest.mark.parametrize(("frames", "queries"), [(5, 0), (0, 3), (1, 1)])
def test_small_tracks(tracks: Tracks, tmp_path: Path, frames: int, queries: int):
    small = tracks.select(list(range(queries)))
    per_frame = ("uv_px", "point_world", "confidence", "visible", "state", "lost_p", "alarm")
    cut = {name: getattr(small, name)[:frames] for name in per_frame}
    small = replace(small, **cut, stamp_s=small.stamp_s[:frames])
    write_tracks(small, tmp_path / "tracks.parquet")
    assert_same(read_tracks(tmp_path / "tracks.parquet"), small)


def test_a_file_is_replaced_whole(tracks: Tracks, tmp_path: Path):
    path = tmp_path / "tracks.parquet"
    path.write_text("old")
    write_tracks(tracks, path)
    assert_same(read_tracks(path), tracks)


def test_missing_torn_and_foreign_files(tracks: Tracks, tmp_path: Path):
    path = tmp_path / "tracks.parquet"
    with pytest.raises(InputError, match=r"tracks\.parquet: no such file"):
        read_tracks(path)
    write_tracks(tracks, path)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match="torn"):
        read_tracks(path)
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(InputError, match=r"not of tracks \(columns a\)"):
        read_tracks(path)


def test_other_version_and_lost_rows(tracks: Tracks, tmp_path: Path):
    path = tmp_path / "tracks.parquet"
    write_tracks(tracks, path)
    table = pq.read_table(path)
    pq.write_table(table.slice(0, 7), path)
    with pytest.raises(InputError, match="7 rows for 5 frames of 3 queries"):
        read_tracks(path)
    raw = table.schema.metadata[b"quest-tracks"].replace(b'"version": 2', b'"version": 99')
    pq.write_table(table.replace_schema_metadata({b"quest-tracks": raw}), path)
    with pytest.raises(InputError, match="format version 99, expected 2"):
        read_tracks(path)
