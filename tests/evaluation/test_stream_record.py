"""Recording streams beside the truth."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.data.store import TakeStore
from quest.errors import ConfigError, InputError
from quest.evaluation import stream_record
from quest.evaluation.selection import Shard, SplitPart
from quest.evaluation.stream_record import (
    StreamRecord,
    lasting,
    lost,
    read_records,
    record_stream,
    record_streams,
    runs,
    tracker_id,
    write_record,
)
from quest.monitor import SIGNALS
from quest.types import Take
from tests.monitor.streams import make_stream
from tests.synthetic import make_take
from tests.tiny import DEFAULT
from tests.track.clips import make_tracker

NAMES: dict[str, SplitPart] = {"panels-100001": "validation", "panels-100002": "validation"}


def equal(a: StreamRecord, b: StreamRecord) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name), equal_nan=f.name in ("signals", "confidence"))
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
    np.testing.assert_array_equal(lasting(flags[:, None])[:, 0], [0, 0, 0, 0, 0, 1, 1, 1])


def test_lost(take: Take):
    """The truth is never lost; nor is an answer that strays for two frames, or only in depth."""
    entities = take.tracked
    uv, point = take.views[0].uv_px[:, entities], take.point_world[:, entities]
    assert take.views[0].visible[:, entities].all()

    def found(uv_px: np.ndarray, point_world: np.ndarray) -> np.ndarray:
        return lost(take, 0, uv_px.astype(np.float32), point_world.astype(np.float32), entities)

    assert not found(uv, point).any()
    swapped_uv, swapped = uv[:, ::-1], point[:, ::-1]
    assert found(swapped_uv, swapped).all()
    frames = np.arange(len(take))[:, None, None]
    for first, last, expected in ((5, 7, False), (5, 8, True)):
        within = (frames >= first) & (frames < last)
        assert found(np.where(within, swapped_uv, uv), np.where(within, swapped, point)).any() == expected
    behind = point + np.array([0.0, 2.0, 0.0])
    assert not found(uv, behind).any()  # the pixel is right: an error of lifting
    assert found(uv + 50.0, behind).all()
    assert found(np.full_like(uv, np.nan), np.full_like(point, np.nan)).all()


def test_a_stream_is_asked_by_true_pixels(take: Take):
    record = record_stream(make_tracker(), take, 0, part="validation")
    assert record is not None
    assert record.signals.shape == (24, 2, len(SIGNALS))
    assert np.isfinite(record.signals[..., SIGNALS.index("right_logit")]).all()
    assert (record.take, record.view, record.object_id, record.part) == (take.info.name, 0, "panels-0", "validation")
    assert (record.asked == 0).all()
    np.testing.assert_array_equal(record.moved, take.moved[take.tracked])
    logit = record.signals[..., SIGNALS.index("right_logit")]
    np.testing.assert_allclose(record.confidence, 1 / (1 + np.exp(-logit)), rtol=1e-5)
    assert record.watched.all()


def test_recording_goes_on_where_it_stopped(store: TakeStore, tmp_path: Path):
    tracker = make_tracker()
    told: list[str] = []

    def record(shard: str) -> tuple[int, int]:
        found = record_streams(
            tracker, [(store, NAMES)], tmp_path, shard=Shard.parse(shard), progress=lambda name, i, n: told.append(name)
        )
        return len(found.records), found.missing

    assert record("0/2") == (2, 2)
    assert told == ["panels-100001 view 0", "panels-100002 view 0"]
    assert record("1/2") == (4, 0)
    assert len(told) == 4
    assert record("0/1") == (4, 0)
    assert len(told) == 4
    records = read_records(tmp_path, made_by=tracker_id(tracker))
    again = record_streams(tracker, [(store, NAMES)], tmp_path, shard=Shard())
    assert all(equal(a, b) for a, b in zip(records, again.records, strict=True))
    assert not list(tmp_path.glob(".*"))


def test_another_tracker_records_again(store: TakeStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    first, second = make_tracker(), make_tracker(seed=1)
    assert tracker_id(first) == tracker_id(make_tracker()) != tracker_id(second)
    with monkeypatch.context() as patched:
        patched.setattr(stream_record, "REVISION", -1)
        changed = tracker_id(first)
    assert changed != tracker_id(first)
    record_streams(first, [(store, NAMES)], tmp_path, shard=Shard(0, 4))
    with pytest.raises(InputError, match="quest weights calibrate"):
        read_records(tmp_path, made_by=tracker_id(second))
    told: list[str] = []
    record_streams(second, [(store, NAMES)], tmp_path, shard=Shard(0, 4), progress=lambda name, i, n: told.append(name))
    assert len(told) == 1
    assert len(read_records(tmp_path, made_by=tracker_id(second))) == 1


def test_records_outlive_what_given_points_are_not_followed_by(take: Take):
    first = make_tracker(replace(DEFAULT, flow=True))
    known = tracker_id(first)
    before = record_stream(first, take, 0, part="validation")
    assert tracker_id(make_tracker()) == known  # without the flow head
    assert tracker_id(first.with_config(replace(first.config, slot_bias=1.0), name="other")) == known
    with torch.no_grad():
        for name, parameter in first.network.named_parameters():
            if name.startswith(("affordance", "flow.")):
                parameter += 1
    assert tracker_id(first) == known
    after = record_stream(first, take, 0, part="validation")
    assert before is not None
    assert after is not None
    assert equal(before, after)
    assert tracker_id(first.with_config(replace(first.config, off_joint=-1.5), name="other")) != known
    with torch.no_grad():
        next(first.network.binder.parameters()).add_(1)
    assert tracker_id(first) != known


def test_a_view_with_nothing_to_follow_is_remembered(tmp_path: Path):
    write_record(None, tmp_path / "empty.npz", made_by="me", take_hash="t")
    write_record(make_stream(0), tmp_path / "full.npz", made_by="me", take_hash="t")
    (record,) = read_records(tmp_path, made_by="me")
    assert equal(record, make_stream(0))


def test_damaged_files(tmp_path: Path):
    path = tmp_path / "a.npz"
    write_record(make_stream(0), path, made_by="me", take_hash="t")
    whole = path.read_bytes()
    for torn in (b"", whole[:100], whole[: len(whole) // 2], b"PK"):
        path.write_bytes(torn)
        with pytest.raises(InputError, match="delete it"):
            read_records(tmp_path, made_by="me")
    np.savez(path, format=np.array(0))  # of a version before: as if it were not there
    with pytest.raises(InputError, match="found none"):
        read_records(tmp_path, made_by="me")


@pytest.mark.slow
def test_takes_that_were_made_again_are_recorded_again(
    store: TakeStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    tracker = make_tracker()
    told: list[str] = []

    def record(part: SplitPart = "validation") -> set[str]:
        found = record_streams(
            tracker,
            [(store, dict.fromkeys(NAMES, part))],
            tmp_path,
            shard=Shard(0, 1),
            progress=lambda name, i, n: told.append(name),
        )
        return {record.part for record in found.records}

    assert (record(), len(told)) == ({"validation"}, 4)
    assert (record("test"), len(told)) == ({"test"}, 4)  # the part is that of today
    monkeypatch.setattr(TakeStore, "data_hash", lambda self, name: "another")
    assert (record(), len(told)) == ({"validation"}, 8)


def test_two_stores_with_one_name(store: TakeStore, tmp_path: Path):
    with pytest.raises(ConfigError, match="twice"):
        record_streams(make_tracker(), [(store, NAMES), (store, NAMES)], tmp_path, shard=Shard())


@pytest.mark.parametrize("text", ["", "1", "2/2", "a/b", "-1/2", "0/0"])
def test_bad_shards(text: str):
    with pytest.raises(ConfigError, match="shard"):
        Shard.parse(text)
