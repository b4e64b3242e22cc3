"""``quest eval`` on a small store, and the choice of takes."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

import quest
from quest.baselines.hold_still import HoldStill
from quest.cli.evaluate import Eval
from quest.data.split import SplitPart, object_split, part_of, split_of
from quest.data.store import TakeStore
from quest.errors import ConfigError, InputError, ObjectError, TakeError
from quest.evaluation import evaluate, read_records, read_results
from quest.evaluation.finished import FinishedTakes
from quest.evaluation.results import records_path
from quest.evaluation.selection import Shard, select_takes
from quest.types import Clip, Query, Take, TakeInfo, Tracks
from tests.evaluation.fakes import Oracle
from tests.synthetic import make_take
from tests.tiny import make_finder


def _take(seed: int, *, level: int = 1) -> Take:
    take = make_take(frames=20, views=2, entities=2, size=(48, 48), seed=seed, name=f"panels-{seed}-{level}")
    return dataclasses.replace(take, info=dataclasses.replace(take.info, level=level))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> TakeStore:
    """Validation objects 100000 (levels 1, 2) and 100001 (level 1), training object 7, one outside all ranges."""
    store = TakeStore(tmp_path_factory.mktemp("takes"))
    for take in (_take(100000), _take(100000, level=2), _take(100001), _take(7), _take(999999)):
        store.write(take)
    return store


def test_split_is_disjoint_and_large_enough() -> None:
    split = object_split()
    named = [o for part in split.partnet_mobility.values() for o in part]
    assert len(named) == len(set(named))
    assert len(split.partnet_mobility["validation"]) >= 8
    assert len(split.partnet_mobility["test"]) >= 8
    ranges = sorted(split.procedural_seeds.values())
    assert all(a[1] < b[0] for a, b in itertools.pairwise(ranges))


def test_split_of(store: TakeStore) -> None:
    info = store.infos()["panels-7-1"]

    def of(source: str, object_id: str) -> TakeInfo:
        return dataclasses.replace(info, source=source, object_id=object_id)  # type: ignore[arg-type]

    assert split_of(info) == "train"
    assert split_of(of("procedural", "base-cabinet-100003")) == "validation"
    assert split_of(of("procedural", "laptop-119999")) == "test"
    assert split_of(of("partnet-mobility", "44817")) == "validation"
    for bad in (of("procedural", "laptop"), of("procedural", "laptop-5000000"), of("partnet-mobility", "99999")):
        with pytest.raises(ObjectError):
            split_of(bad)
        assert part_of(bad) == "unlisted"


def test_training_objects_need_to_be_named(store: TakeStore) -> None:
    infos = store.infos()
    assert select_takes(infos, split=("validation", "test", "unlisted")) == {
        "panels-100000-1": "validation",
        "panels-100000-2": "validation",
        "panels-100001-1": "validation",
        "panels-999999-1": "unlisted",
    }
    assert select_takes(infos, split=("train",)) == {"panels-7-1": "train"}
    with pytest.raises(ConfigError, match="--split train"):
        select_takes(infos, split=("validation",), objects=("panels-7",))


def test_selection(store: TakeStore) -> None:
    infos = store.infos()
    assert list(select_takes(infos, split=("validation",), levels=(2,))) == ["panels-100000-2"]
    assert list(select_takes(infos, split=("validation",), objects=("panels-100001",))) == ["panels-100001-1"]
    same = select_takes(infos, split=("validation",), same_objects=True)
    assert list(same) == ["panels-100000-1", "panels-100000-2"]
    with pytest.raises(ConfigError, match="panels-5: not in the store"):
        select_takes(infos, split=("validation",), objects=("panels-5",))
    with pytest.raises(ConfigError, match="no takes"):
        select_takes({}, split=("validation",))


def test_evaluate_refuses_what_no_tracker_can(store: TakeStore) -> None:
    with pytest.raises(ConfigError, match="has the protocol semantic"):
        evaluate(store, {"panels-100001-1": "validation"}, [HoldStill()], protocols=("semantic",))
    with pytest.raises(ConfigError, match="different names"):
        evaluate(store, {"panels-100001-1": "validation"}, [HoldStill(), HoldStill()])


def test_a_protocol_named_twice_is_one(store: TakeStore) -> None:
    found = evaluate(store, {"panels-100001-1": "validation"}, [HoldStill()], protocols=("point", "point"))
    assert len({(r.take, r.view, r.entity) for r in found.records}) == len(found.records) > 0


def test_progress_counts_every_frame(store: TakeStore) -> None:
    seen: list[int] = []
    evaluate(store, {"panels-100001-1": "validation"}, [HoldStill()], progress=lambda _, frames: seen.append(frames))
    assert sum(seen) == 2 * 20


@pytest.mark.plain  # the tracker is not of the class that is declared
def test_command_writes_what_it_prints(
    store: TakeStore, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    oracle = Oracle(store.read("panels-100001-1"), name="quest", slots=(0, 1))
    oracle.network = make_finder()
    monkeypatch.setattr(quest, "load", lambda weights: oracle, raising=False)
    monkeypatch.setenv("COLUMNS", "200")
    out = tmp_path / "results.json"
    command = Eval(
        takes=str(store.root),
        protocol=("point", "semantic"),
        trackers=("quest", "lk"),
        objects=("panels-100001",),
        resamples=10,
        out=out,
    )
    assert command.run() == 0
    printed = capsys.readouterr().out
    results = read_results(out)
    trackers = {(row.protocol, row.tracker) for row in results.rows}
    assert trackers == {("point", "quest"), ("point", "lk"), ("point", "hold-still"), ("semantic", "quest")}
    for row in results.rows:
        assert (row.part, row.source, row.level, row.objects, row.takes) == ("validation", "procedural", 1, 1, 1)
        assert row.metrics.ape is not None
        if row.tracker == "quest":
            assert row.metrics.ape.mean == 0.0
        assert f"{row.metrics.ape.mean:.3f}" in printed
    assert results.run.weights == "quest-s16"
    assert len(results.run.data_hash) == 64
    assert results.run.commit
    assert len(read_records(records_path(out))) == sum(row.tracks for row in results.rows if row.reading == "all")


def test_command_reports_training_objects_as_such(store: TakeStore, capsys: pytest.CaptureFixture) -> None:
    assert Eval(takes=str(store.root), trackers=("hold-still",), split=("train",), resamples=5).run() == 0
    assert "TRAINING OBJECTS" in capsys.readouterr().out


def test_command_says_when_levels_do_not_compare(store: TakeStore, capsys: pytest.CaptureFixture) -> None:
    command = Eval(takes=str(store.root), trackers=("hold-still",), split=("validation",), resamples=5)
    assert command.run() == 0
    assert "--same-objects" in capsys.readouterr().out
    assert dataclasses.replace(command, same_objects=True).run() == 0
    assert "--same-objects" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "error", "match"),
    [
        ({"takes": "no-such-folder"}, TakeError, "quest generate"),
        ({"resamples": 0}, ConfigError, "resamples"),
        ({"seed": -1}, ConfigError, "seed"),
        ({"out": Path("result.txt")}, ConfigError, "json"),
        ({"protocol": ("semantic",), "trackers": ("lk",)}, ConfigError, "semantic"),
        ({"level": (4,)}, ConfigError, "no take is left"),
        ({"shard": "²/3"}, ConfigError, "shard"),
    ],
)
def test_command_errors(store: TakeStore, changes: dict, error: type[Exception], match: str) -> None:
    command = dataclasses.replace(Eval(takes=str(store.root), trackers=("hold-still",)), **changes)
    with pytest.raises(error, match=match):
        command.run()


def test_torn_takes_are_left_out_and_named(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    store = TakeStore(tmp_path)
    store.write(_take(100000))
    (tmp_path / "torn.zarr").mkdir()
    assert Eval(takes=str(tmp_path), trackers=("hold-still",), resamples=5).run() == 0
    assert "corrupt takes of the store were omitted: torn" in capsys.readouterr().out


class _Counting(HoldStill):
    """Counts what it is asked, and is stopped before the clip of a name."""

    def __init__(self, stop_at: str | None = None) -> None:
        self.clips: list[str] = []
        self._stop_at = stop_at

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        if self._stop_at is not None and clip.name.startswith(self._stop_at):
            raise KeyboardInterrupt
        self.clips.append(clip.name)
        return super().track(clip, queries)


VALIDATION: Mapping[str, SplitPart] = dict.fromkeys(
    ("panels-100000-1", "panels-100000-2", "panels-100001-1"), "validation"
)


def test_what_was_stopped_goes_on(store: TakeStore, tmp_path: Path) -> None:
    whole = evaluate(store, VALIDATION, [HoldStill()])
    folder = tmp_path / "parts"
    with pytest.raises(KeyboardInterrupt):
        evaluate(store, VALIDATION, [_Counting("panels-100001")], finished=FinishedTakes(folder, made_by="a"))
    assert len(list(folder.iterdir())) == 2
    second, frames = _Counting(), list[int]()
    found = evaluate(
        store,
        VALIDATION,
        [second],
        finished=FinishedTakes(folder, made_by="a"),
        progress=lambda _, n: frames.append(n),
    )
    assert [name.partition("/")[0] for name in second.clips] == ["panels-100001-1"] * 2
    assert sum(frames) == 3 * 2 * 20
    assert [r.subject for r in found.records] == [r.subject for r in whole.records]
    for a, b in zip(found.records, whole.records, strict=True):
        np.testing.assert_array_equal(a.distance, b.distance)
    assert (found.unscored, found.notes, found.missing) == (whole.unscored, whole.notes, 0)


def test_finished_takes_of_other_code_or_data_do_not_count(store: TakeStore, tmp_path: Path) -> None:
    evaluate(store, VALIDATION, [HoldStill()], finished=FinishedTakes(tmp_path, made_by="a"))
    name = "panels-100001-1"
    assert FinishedTakes(tmp_path, made_by="a").read(name, store.data_hash(name)) is not None
    assert FinishedTakes(tmp_path, made_by="b").read(name, store.data_hash(name)) is None
    assert FinishedTakes(tmp_path, made_by="a").read(name, "other") is None
    (tmp_path / f"{name}.parquet").write_bytes(b"PAR1")
    with pytest.raises(InputError, match="Parquet"):
        FinishedTakes(tmp_path, made_by="a").read(name, store.data_hash(name))


def test_shards_share_an_evaluation(store: TakeStore, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    def command(shard: str, out: str) -> Eval:
        return Eval(
            takes=str(store.root), trackers=("lk",), split=("validation",), resamples=5, shard=shard, out=tmp_path / out
        )

    assert command("1/2", "shared.json").run() == 0
    assert "left to other shards: 2 takes" in capsys.readouterr().err
    assert not (tmp_path / "shared.json").exists()
    assert command("0/2", "shared.json").run() == 0
    assert command("0/1", "alone.json").run() == 0
    assert read_results(tmp_path / "shared.json").rows == read_results(tmp_path / "alone.json").rows
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".json", ".json", ".parquet", ".parquet"]
    with pytest.raises(ConfigError, match="--out"):
        dataclasses.replace(command("0/2", "x.json"), out=None).run()
    with pytest.raises(ConfigError, match="finished takes"):
        evaluate(store, VALIDATION, [HoldStill()], shard=Shard(0, 2))
