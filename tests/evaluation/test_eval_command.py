"""``quest eval`` on a small store, and the choice of takes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

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
from quest.types import Take
from tests.evaluation.fakes import Oracle, Stopped
from tests.synthetic import make_take
from tests.tiny import make_finder


def _take(seed: int, *, level: int = 1) -> Take:
    take = make_take(frames=20, views=2, entities=2, size=(48, 48), seed=seed, name=f"panels-{seed}-{level}")
    return replace(take, info=replace(take.info, level=level))


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
    assert min(len(split.partnet_mobility[part]) for part in ("validation", "test")) >= 8
    imported = [name for part in split.sweethome3d.values() for name in part]
    assert len(imported) == len(set(imported))
    assert [len(split.sweethome3d[part]) for part in ("train", "validation", "test")] == [66, 12, 12]
    ranges = sorted(split.procedural_seeds.values())
    assert all(a[1] < b[0] for a, b in itertools.pairwise(ranges))


@pytest.mark.parametrize(
    ("source", "object_id", "part"),
    [
        ("procedural", "panels-7", "train"),
        ("procedural", "base-cabinet-100003", "validation"),
        ("procedural", "laptop-119999", "test"),
        ("partnet-mobility", "44817", "validation"),
        *(("procedural", name, "unlisted") for name in ("laptop", "laptop-5000000")),
        ("partnet-mobility", "99999", "unlisted"),
        ("sweethome3d", "fridge", "test"),
        ("sweethome3d", "something", "unlisted"),
    ],
)
def test_split_of(source: Literal["procedural", "partnet-mobility", "sweethome3d"], object_id: str, part: str) -> None:
    info = replace(make_take(frames=1, views=1, size=(8, 8)).info, source=source, object_id=object_id)
    assert part_of(info) == part
    if part == "unlisted":
        with pytest.raises(ObjectError):
            split_of(info)
    else:
        assert split_of(info) == part


def test_selection(store: TakeStore) -> None:
    infos, validation = store.infos(), ["panels-100000-1", "panels-100000-2", "panels-100001-1"]
    parts = dict.fromkeys(validation, "validation") | {"panels-999999-1": "unlisted"}
    assert select_takes(infos, split=("validation", "test", "unlisted")) == parts
    assert select_takes(infos, split=("train",)) == {"panels-7-1": "train"}
    assert list(select_takes(infos, split=("validation",), levels=(2,))) == validation[1:2]
    assert list(select_takes(infos, split=("validation",), objects=("panels-100001",))) == validation[2:]
    assert list(select_takes(infos, split=("validation",), same_objects=True)) == validation[:2]
    for of, objects, match in (
        (infos, ("panels-7",), "--split train"),
        (infos, ("panels-5",), "not in"),
        ({}, (), "no"),
    ):
        with pytest.raises(ConfigError, match=match):
            select_takes(of, split=("validation",), objects=objects)


def test_what_an_evaluation_is_asked_for(store: TakeStore) -> None:
    one: Mapping[str, SplitPart] = {"panels-100001-1": "validation"}
    for trackers, protocol, match in (
        ([HoldStill()], "semantic", "has the protocol semantic"),
        ([HoldStill(), HoldStill()], "point", "different names"),
    ):
        with pytest.raises(ConfigError, match=match):
            evaluate(store, one, trackers, protocols=(protocol,))  # type: ignore[arg-type]
    seen: list[int] = []
    twice = evaluate(
        store, one, [HoldStill()], protocols=("point",) * 2, progress=lambda _, frames: seen.append(frames)
    )
    assert len({(r.take, r.view, r.entity) for r in twice.records}) == len(twice.records) > 0
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


def test_command_says_what_to_mind(store: TakeStore, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    torn = TakeStore(tmp_path)
    torn.write(_take(100000))
    (tmp_path / "torn.zarr").mkdir()
    whole, validation = str(store.root), ("validation",)
    plain = Eval(takes=whole, trackers=("hold-still",), resamples=5)
    for changes, said, unsaid in (
        ({"split": ("train",)}, "TRAINING OBJECTS", "--same-objects"),
        ({"split": validation}, "--same-objects", "TRAINING OBJECTS"),
        ({"split": validation, "same_objects": True}, "validation objects", "--same-objects"),
        ({"takes": str(tmp_path)}, "corrupt takes of the store were omitted: torn", "TRAINING OBJECTS"),
    ):
        assert replace(plain, **changes).run() == 0
        out = capsys.readouterr().out
        assert said in out
        assert unsaid not in out


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
    command = replace(Eval(takes=str(store.root), trackers=("hold-still",)), **changes)
    with pytest.raises(error, match=match):
        command.run()


VALIDATION: Mapping[str, SplitPart] = dict.fromkeys(
    ("panels-100000-1", "panels-100000-2", "panels-100001-1"), "validation"
)


def test_what_was_stopped_goes_on(store: TakeStore, tmp_path: Path) -> None:
    whole = evaluate(store, VALIDATION, [HoldStill()])
    folder = tmp_path / "parts"
    with pytest.raises(KeyboardInterrupt):
        evaluate(store, VALIDATION, [Stopped(4)], finished=FinishedTakes(folder, made_by="a"))
    assert len(list(folder.iterdir())) == 2
    second, frames = Stopped(), list[int]()
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
    (tmp_path / f"{name}.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match="delete the file"):
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
        replace(command("0/2", "x.json"), out=None).run()
    with pytest.raises(ConfigError, match="finished takes"):
        evaluate(store, VALIDATION, [HoldStill()], shard=Shard(0, 2))
