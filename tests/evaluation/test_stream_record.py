"""Recording streams beside the truth."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from quest.data.split import SplitPart
from quest.data.store import TakeStore
from quest.errors import ConfigError, InputError
from quest.evaluation import stream_record
from quest.evaluation.selection import Shard
from quest.evaluation.stream_record import (
    LOST,
    RIGHT,
    UNCLEAR,
    Recorded,
    StreamRecord,
    bands,
    duration_s,
    lasting,
    read_records,
    record_stream,
    record_streams,
    runs,
    tracker_id,
    write_record,
)
from quest.filter.noise import Noise
from quest.monitor import Inputs
from quest.track import Tracker
from quest.types import Take
from tests.monitor.streams import make_stream
from tests.synthetic import make_take
from tests.track.clips import make_tracker

NAMES = ("panels-100001", "panels-100002")


def equal(a: StreamRecord, b: StreamRecord) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name), equal_nan=f.name in ("log_odds", "readings"))
               for f in fields(StreamRecord))  # fmt: skip


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=24, views=1, entities=2, size=(64, 64), seed=0)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> TakeStore:
    store = TakeStore(tmp_path_factory.mktemp("takes"))
    for seed, name in enumerate(NAMES):
        store.write(make_take(frames=9, views=2, entities=2, size=(64, 64), seed=seed, name=name))
    return store


def test_runs():
    flags = np.array([1, 1, 0, 1, 0, 1, 1, 1], bool)
    assert runs(flags) == [(0, 2), (3, 4), (5, 8)]
    assert runs(np.zeros(3, bool)) == []
    stamp_s = np.arange(8) / 30
    assert [duration_s(stamp_s, *run) for run in runs(flags)] == [0.067, 0.033, 0.1]
    np.testing.assert_array_equal(lasting(flags[:, None], stamp_s, 0.1)[:, 0], [0, 0, 0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(lasting(flags[:, None], 2 * stamp_s, 0.1)[:, 0], [1, 1, 0, 0, 0, 1, 1, 1])
    assert duration_s(np.zeros(1), 0, 1) == 0.0


def test_bands_with_depth(take: Take):
    """By 3D distance in normalised units; an answer that strays for two frames, or only in depth, is not lost."""
    entities, half = take.tracked, take.info.half_diagonal_m
    uv, point = take.views[0].uv_px[:, entities], take.point_world[:, entities]
    assert take.views[0].visible[:, entities].all()

    def found(uv_px: np.ndarray, point_world: np.ndarray) -> np.ndarray:
        return bands(take, 0, uv_px.astype(np.float32), point_world.astype(np.float32), entities, inputs="depth")

    def off(distance: float) -> np.ndarray:
        return found(uv + 50, point + np.array([0, distance * half, 0]))

    assert (found(uv, point) == RIGHT).all()
    for distance, band in ((0.069, RIGHT), (0.071, UNCLEAR), (0.139, UNCLEAR), (0.141, LOST)):
        assert (off(distance) == band).all()
    assert (found(uv, point + np.array([0, 2, 0])) == RIGHT).all()  # the pixel is right: an error of lifting
    swapped_uv, swapped = uv[:, ::-1], point[:, ::-1]
    assert (found(swapped_uv, swapped) == LOST).all()
    frames = np.arange(len(take))[:, None, None]
    for first, last, expected in ((5, 7, UNCLEAR), (5, 8, LOST)):
        within = (frames >= first) & (frames < last)
        band = found(np.where(within, swapped_uv, uv), np.where(within, swapped, point))
        assert (band[first:last] == expected).all()
        assert (band[:first] == RIGHT).all()
        assert (band[last:] == RIGHT).all()
    assert (found(np.full_like(uv, np.nan), np.full_like(point, np.nan)) == LOST).all()


def test_near_another_entity_is_lost_sooner(take: Take):
    """Two thirds of the way to an entity that is 0.12 away: 0.08 from its own, 0.04 from the other."""
    entities, half = take.tracked, take.info.half_diagonal_m
    point = take.point_world.copy()
    point[:, entities[1]] = point[:, entities[0]] + [0, 0.12 * half, 0]
    close = replace(take, point_world=point)
    uv, mine = take.views[0].uv_px[:, entities] + 50, point[:, entities]
    for share, band in ((0.4, RIGHT), (0.55, UNCLEAR), (0.65, UNCLEAR), (0.7, LOST)):
        between = (mine + share * (mine[:, ::-1] - mine)).astype(np.float32)
        assert (bands(close, 0, uv, between, entities, inputs="depth") == band).all(), share


def test_bands_of_colours(take: Take):
    """By pixels of a picture 640 wide, while the entity is in view; this one is 64 wide."""
    entities, view = take.tracked, take.views[0]
    uv, nowhere = view.uv_px[:, entities], np.full_like(take.point_world[:, entities], np.nan)
    up = np.array([0.0, 1.0], np.float32)

    def found(uv_px: np.ndarray, of: Take = take) -> np.ndarray:
        return bands(of, 0, uv_px.astype(np.float32), nowhere, entities, inputs="colours")

    for distance_px, band in ((11.9, RIGHT), (12.1, UNCLEAR), (31.9, UNCLEAR), (32.1, LOST)):
        assert (found(uv + distance_px / 10 * up) == band).all(), distance_px
    true_px = view.uv_px.copy()
    true_px[:, entities[1]] = true_px[:, entities[0]] + 2.4 * up
    close = replace(take, views=(replace(view, uv_px=true_px),))
    mine = true_px[:, entities]
    for share, band in ((0.4, RIGHT), (0.6, UNCLEAR), (0.7, LOST)):
        assert (found(mine + share * (mine[:, ::-1] - mine), close) == band).all(), share
    true_px[:5, entities[0]] = [-1.0, 30.0]
    true_px[5:9, entities[0]] = np.nan
    band = found(np.full_like(uv, np.nan), replace(take, views=(replace(view, uv_px=true_px),)))
    assert (band[:9, 0] == UNCLEAR).all()
    assert (band[9:, 0] == LOST).all()
    assert (band[:, 1] == LOST).all()


@pytest.mark.parametrize("inputs", ["depth", "colours"])
def test_a_stream_is_asked_by_true_pixels(take: Take, inputs: Inputs):
    record = record_stream(make_tracker(), take, 0, part="validation", inputs=inputs)
    assert record is not None
    assert record.log_odds.shape == record.band.shape == (24, 2)
    assert np.isfinite(record.log_odds).all()
    assert (record.take, record.view, record.object_id, record.part) == (take.info.name, 0, "panels-0", "validation")
    assert (record.asked == 0).all()
    assert record.inputs == inputs
    np.testing.assert_array_equal(record.moved, take.moved[take.tracked])
    assert record.watched.all()
    assert record.right[0].all()


def recorded(
    tracker: Tracker, store: TakeStore, folder: Path, shard: str = "0/1", part: SplitPart = "validation"
) -> tuple[Recorded, list[str]]:
    """What a folder has after a run, and what the run recorded."""
    told: list[str] = []
    takes: dict[str, SplitPart] = dict.fromkeys(NAMES, part)
    how = Shard.parse(shard)
    found = record_streams(
        tracker, [(store, takes)], folder, inputs="depth", shard=how, progress=lambda n, *_: told.append(n)
    )
    return found, told


def test_recording_goes_on_where_it_stopped(store: TakeStore, tmp_path: Path):
    tracker = make_tracker()
    found, told = recorded(tracker, store, tmp_path, "0/2")
    assert (len(found.records), found.missing) == (2, 2)
    assert told == ["panels-100001 view 0, depth", "panels-100002 view 0, depth"]
    for shard, new in (("1/2", 2), ("0/1", 0)):
        found, told = recorded(tracker, store, tmp_path, shard)
        assert (len(found.records), found.missing, len(told)) == (4, 0, new)
    records = read_records(tmp_path, inputs="depth", made_by=tracker_id(tracker))
    assert all(equal(a, b) for a, b in zip(records, found.records, strict=True))
    assert not list(tmp_path.glob(".*"))


def test_another_tracker_records_again(store: TakeStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """One with other noise parameters or other code; not one with other weights, which do not follow points."""
    first, second = make_tracker(), make_tracker()
    second.noise = replace(Noise(), stray=0.06)
    assert tracker_id(first) == tracker_id(make_tracker(seed=1)) != tracker_id(second)
    with monkeypatch.context() as patched:
        patched.setattr(stream_record, "REVISION", -1)
        changed = tracker_id(first)
    assert changed != tracker_id(first)
    recorded(first, store, tmp_path, "0/4")
    with pytest.raises(InputError, match="quest calibrate"):
        read_records(tmp_path, inputs="depth", made_by=tracker_id(second))
    assert len(recorded(second, store, tmp_path, "0/4")[1]) == 1
    assert len(read_records(tmp_path, inputs="depth", made_by=tracker_id(second))) == 1
    with pytest.raises(InputError, match="0 files of colours"):
        read_records(tmp_path, inputs="colours", made_by=tracker_id(second))


def test_a_view_with_nothing_to_follow_is_remembered(tmp_path: Path):
    write_record(None, tmp_path / "empty-depth.npz", made_by="me", take_hash="t")
    write_record(make_stream(0), tmp_path / "full-depth.npz", made_by="me", take_hash="t")
    (record,) = read_records(tmp_path, inputs="depth", made_by="me")
    assert equal(record, make_stream(0))


def test_damaged_files(tmp_path: Path):
    path = tmp_path / "a-depth.npz"
    write_record(make_stream(0), path, made_by="me", take_hash="t")
    whole = path.read_bytes()
    for torn in (b"", whole[:100], whole[: len(whole) // 2], b"PK"):
        path.write_bytes(torn)
        with pytest.raises(InputError, match="delete it"):
            read_records(tmp_path, inputs="depth", made_by="me")
    np.savez(path, format=np.array(0))  # of a version before: as if it were not there
    with pytest.raises(InputError, match="found none"):
        read_records(tmp_path, inputs="depth", made_by="me")


@pytest.mark.slow
def test_takes_that_were_made_again_are_recorded_again(
    store: TakeStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    tracker = make_tracker()

    def record(part: SplitPart = "validation") -> tuple[set[str], int]:
        found, told = recorded(tracker, store, tmp_path, part=part)
        return {record.part for record in found.records}, len(told)

    assert record() == ({"validation"}, 4)
    assert record("test") == ({"test"}, 0)  # the part is that of today
    monkeypatch.setattr(TakeStore, "data_hash", lambda self, name: "another")
    assert record() == ({"validation"}, 4)


def test_two_stores_with_one_name(store: TakeStore, tmp_path: Path):
    takes: dict[str, SplitPart] = dict.fromkeys(NAMES, "test")
    twice = [(store, takes)] * 2
    with pytest.raises(ConfigError, match="twice"):
        record_streams(make_tracker(), twice, tmp_path, inputs="depth", shard=Shard())


@pytest.mark.parametrize("text", ["", "1", "2/2", "a/b", "-1/2", "0/0"])
def test_bad_shards(text: str):
    with pytest.raises(ConfigError, match="shard"):
        Shard.parse(text)
