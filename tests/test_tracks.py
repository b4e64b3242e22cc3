"""Tracks as Parquet: round trip, readable columns, and typed errors for what is not a file of tracks."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from quest.errors import InputError, MissingExtraError
from quest.tracks import COLUMNS, read_tracks, write_joints, write_tracks
from quest.types import Joints, State, Tracks


@pytest.fixture
def tracks() -> Tracks:
    rng = np.random.default_rng(0)
    uv_px, point = rng.normal(size=(5, 3, 2)), rng.normal(size=(5, 3, 3))
    uv_px[:2, 1], point[:2, 1], point[3, 0] = np.nan, np.nan, np.nan
    covariance = np.full((3, 6, 6), np.nan, np.float32)
    covariance[0], covariance[1, 3:, 3:] = rng.normal(size=(6, 6)), np.eye(3)
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
            q_min_seen=np.array([-0.1, np.nan, np.nan], np.float32),
            q_max_seen=np.array([1.2, np.nan, np.nan], np.float32),
            q=np.where(np.arange(3) == 0, rng.uniform(size=(5, 3)), np.nan).astype(np.float32),
            covariance=covariance,
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
        for name in ("axis", "origin", "q_min_seen", "q_max_seen", "q", "covariance"):
            np.testing.assert_array_equal(getattr(found.joints, name), getattr(expected.joints, name))


def cut(tracks: Tracks, frames: int, queries: int) -> Tracks:
    """The first frames and queries."""
    small = tracks.select(list(range(queries)))
    per_frame = ("uv_px", "point_world", "confidence", "visible", "state", "lost_p", "alarm", "stamp_s")
    assert small.joints is not None
    joints = replace(small.joints, q=small.joints.q[:frames])
    return replace(small, **{name: getattr(small, name)[:frames] for name in per_frame}, joints=joints)


@pytest.mark.parametrize("size", [(5, 3), (5, 0), (0, 3), (1, 1)])
@pytest.mark.parametrize("watched", [True, False])
def test_tracks_come_back(tracks: Tracks, tmp_path: Path, size: tuple[int, int], watched: bool):
    """Also of trackers that do not watch themselves; a file that is there is replaced whole."""
    kept = cut(tracks, *size)
    kept = kept if watched else replace(kept, lost_p=None, alarm=None, joints=None)
    path = tmp_path / "out" / "tracks.parquet"
    path.parent.mkdir()
    path.write_text("old")
    write_tracks(kept, path)
    found = read_tracks(path)
    assert_same(found, kept)
    assert (found.state == State.HELD).sum() == (kept.state == State.HELD).sum()
    assert [each.name for each in path.parent.iterdir()] == ["tracks.parquet"]


def test_columns_that_other_programs_read(tracks: Tracks, tmp_path: Path):
    write_tracks(tracks, tmp_path / "tracks.parquet")
    table = pq.read_table(tmp_path / "tracks.parquet")
    assert table.schema.names == list(COLUMNS)
    rows = table.to_pylist()
    assert len(rows) == 15
    assert (rows[4]["frame"], rows[4]["query"], rows[4]["name"], rows[4]["label"]) == (1, 1, "slot-1", None)
    assert rows[4]["x_px"] is None
    assert rows[4]["z_m"] is None
    assert rows[3]["y_m"] == tracks.point_world[1, 0, 1]


def test_a_folder_gets_the_joints_as_well(tracks: Tracks, tmp_path: Path):
    tracks.save(tmp_path / "out")
    assert_same(read_tracks(tmp_path / "out" / "tracks.parquet"), tracks)
    whole = json.loads((tmp_path / "out" / "joints.json").read_text(encoding="utf-8"))
    assert whole["stamp_s"] == tracks.stamp_s.tolist()
    turning, still, unknown = whole["joints"]
    assert tracks.joints is not None
    assert (turning["name"], turning["label"], turning["kind"]) == ("link_0/handle", "handle", "revolute")
    assert turning["axis"] == [0, 0, 1]
    assert (turning["q_min_seen"], turning["q_max_seen"]) == (-0.1, 1.2)
    np.testing.assert_allclose(turning["q"], tracks.joints.q[:, 0], rtol=1e-5)
    np.testing.assert_allclose(turning["covariance"], tracks.joints.covariance[0], rtol=1e-5)
    assert (still["kind"], still["axis"], still["q"], still["covariance"][0]) == ("static", None, None, None)
    assert still["covariance"][3] == [None, None, None, 1, 0, 0]
    assert {unknown[name] for name in ("axis", "origin_m", "q_min_seen", "q_max_seen", "covariance", "q")} == {None}


def test_where_tracks_can_be_saved(tracks: Tracks, tmp_path: Path):
    tracks.save(tmp_path / "mine.parquet")
    assert_same(read_tracks(tmp_path / "mine.parquet"), tracks)
    replace(tracks, joints=None).save(tmp_path / "plain")
    assert [path.name for path in tmp_path.joinpath("plain").iterdir()] == ["tracks.parquet"]
    for name in ("tracks.csv", "mine.parquet/deeper.json"):
        with pytest.raises(InputError, match=r"expected a folder, or a file that ends in \.parquet"):
            tracks.save(tmp_path / name)
    with pytest.raises(InputError, match="have none"):
        write_joints(replace(tracks, joints=None), tmp_path / "joints.json")


def test_tables_of_pandas(tracks: Tracks, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pandas", None)
        with pytest.raises(MissingExtraError, match=r"\[pandas\]"):
            tracks.to_pandas()
    pytest.importorskip("pandas")
    table = tracks.to_pandas()
    assert list(table.columns) == list(COLUMNS)
    assert len(table) == 15
    last = table[(table["name"] == "link_0/handle") & (table["frame"] == 4)]
    assert tracks.joints is not None
    assert last["q"].item() == tracks.joints.q[4, 0]
    assert int(table["x_px"].isna().to_numpy().sum()) == 2


def test_what_is_no_file_of_tracks(tracks: Tracks, tmp_path: Path):
    path, other = tmp_path / "tracks.parquet", tmp_path / "other.parquet"
    write_tracks(tracks, path)
    table = pq.read_table(path)
    raw = table.schema.metadata[b"quest-tracks"].replace(b'"version": 3', b'"version": 99')
    for wrong, match in (
        (None, r"other\.parquet: no such file"),
        (path.read_bytes()[:-20], "copy it again"),
        (pa.table({"a": [1]}), r"not of tracks \(columns a\)"),
        (table.slice(0, 7), "7 rows for 5 frames of 3 queries"),
        (table.replace_schema_metadata({b"quest-tracks": raw}), "format version 99, expected 3"),
    ):
        if isinstance(wrong, bytes):
            other.write_bytes(wrong)
        elif wrong is not None:
            pq.write_table(wrong, other)
        with pytest.raises(InputError, match=match):
            read_tracks(other)
