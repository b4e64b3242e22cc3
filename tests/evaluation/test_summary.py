"""Pooling, readings, intervals, and the file that keeps them."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
from rich.console import Console

from quest.errors import InputError
from quest.evaluation import (
    Discovery,
    EntityRecord,
    Results,
    Run,
    Subject,
    Unscored,
    read_records,
    read_results,
    results_table,
    summarise,
    write_results,
)
from quest.evaluation.bootstrap import draw_objects, interval_over, mean_value, median_value
from quest.evaluation.metrics import Sums
from quest.evaluation.results import records_path
from tests.evaluation.answers import make_answer

RUN = Run("quest eval", "abc", "def", None, None, 50, 0, "machine", {"python": "3"}, "2026-01-01T00:00:00", 1.0)


def _record(rng: np.random.Generator, i: int, *, frames: int = 20, **changes: object) -> EntityRecord:
    subject = Subject("fake", "point", "validation", "procedural", 1, f"box-{i % 4}")
    distance_px = rng.uniform(0, 9, size=frames).astype(np.float32)
    distance_px[i % frames] = np.nan
    record = EntityRecord(
        subject=subject,
        take=f"take-{i % 5}",
        view=i % 3,
        entity=i % 2,
        name=f"link_{i % 2}/rim",
        label="rim",
        moved=i % 3 == 0,
        found=True,
        first_frame=i % 4,
        distance=rng.uniform(size=frames).astype(np.float32),
        distance_px=distance_px,
        follows=rng.integers(-1, 2, size=frames).astype(np.int16),
        visible=rng.uniform(size=frames) > 0.3,
    )
    return dataclasses.replace(record, **changes)  # type: ignore[arg-type]


@pytest.fixture
def records() -> tuple[EntityRecord, ...]:
    rng = np.random.default_rng(1)
    return tuple(_record(rng, i, frames=20 if i % 2 else 33) for i in range(14))


def test_suites_have_rows_of_their_own() -> None:
    takes = ("box-1-L1-s000000", "box-1-L1-noise-0-s000000", "box-1-L1-noise-5-s000000", "box-1-L1-occlusion-s000000")
    records = [make_answer([0.1 * i] * 4, take=take) for i, take in enumerate(takes)]
    rows = {row.suite: row for row in summarise(records, resamples=5, seed=0) if row.reading == "all"}
    assert list(rows) == ["noise-0", "noise-5", "occlusion", "standard"]
    ape = rows["noise-5"].metrics.ape
    assert ape is not None
    assert ape.mean == pytest.approx(0.2)
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(results_table(Results(RUN, tuple(rows.values()))))
    text = console.export_text()
    assert "suite noise-5" in text
    assert "suite standard" not in text


def test_rows_pool_frames_of_records_of_any_length(records: tuple[EntityRecord, ...]) -> None:
    rows = {row.reading: row for row in summarise(records, resamples=30, seed=0)}
    for reading, kept in (("all", records), ("moved", [r for r in records if r.moved])):
        metrics, row = rows[reading].metrics, rows[reading]
        gaps = [r.distance[r.first_frame :] for r in kept]
        assert metrics.ape is not None
        assert metrics.ape.mean == pytest.approx(np.concatenate(gaps).mean())
        assert metrics.ape.count == row.frames == sum(map(len, gaps))
        assert metrics.d100 is not None
        assert metrics.d100.mean == pytest.approx(np.mean([r.distance[-1] for r in kept]))
        seen = [r.distance_px[r.first_frame :][r.visible[r.first_frame :]] for r in kept]
        assert metrics.median_px_vis is not None
        assert metrics.median_px_vis.mean == pytest.approx(np.nanmedian(np.concatenate(seen)))
        right = [(r.follows == r.entity)[r.first_frame :] for r in kept]
        assert metrics.acc is not None
        assert metrics.acc.mean == pytest.approx(np.concatenate(right).mean())
        assert row.tracks == len(kept)
        assert row.takes == len({r.take for r in kept})
        assert row.entities == len({(r.take, r.entity) for r in kept})
        assert row.objects == len({r.subject.object_id for r in kept})
        assert metrics.precision is None
        assert metrics.recall is None


def test_rows_are_kept_apart_and_do_not_depend_on_each_other(records: tuple[EntityRecord, ...]) -> None:
    other = tuple(
        dataclasses.replace(r, subject=dataclasses.replace(r.subject, source="partnet-mobility")) for r in records
    )
    level = tuple(dataclasses.replace(r, subject=dataclasses.replace(r.subject, level=4)) for r in records)
    train = tuple(dataclasses.replace(r, subject=dataclasses.replace(r.subject, part="train")) for r in records)
    alone = summarise(records, resamples=30, seed=0)
    together = summarise(records + other + level + train, resamples=30, seed=0)
    assert len(together) == 4 * len(alone)
    assert set(alone) <= set(together)


def test_no_moved_entity_gives_no_moved_row(records: tuple[EntityRecord, ...]) -> None:
    still = tuple(dataclasses.replace(r, moved=False) for r in records)
    assert [row.reading for row in summarise(still, resamples=5, seed=0)] == ["all"]
    assert summarise((), resamples=5, seed=0) == ()


def test_nothing_visible_has_no_visible_metrics(records: tuple[EntityRecord, ...]) -> None:
    blind = tuple(dataclasses.replace(r, visible=np.zeros_like(r.visible)) for r in records)
    metrics = summarise(blind, resamples=5, seed=0)[0].metrics
    assert metrics.ape_vis is None
    assert metrics.median_px_vis is None
    assert metrics.ape is not None


def test_bootstrap_equals_resampling_the_objects_by_hand() -> None:
    rng = np.random.default_rng(0)
    owner = rng.integers(0, 5, size=60)
    value = rng.exponential(size=60) + owner
    draws = draw_objects(5, resamples=200, generator=np.random.default_rng(3))
    assert (draws.sum(axis=1) == 5).all()
    means, medians = [], []
    for drawn in draws:
        pooled = np.concatenate([np.tile(value[owner == o], n) for o, n in enumerate(drawn)])
        means.append(pooled.mean())
        medians.append(np.median(pooled))
    mean = mean_value(Sums(value, np.ones(60)), owner, draws)
    median = median_value(value, owner, draws)
    assert mean is not None
    assert median is not None
    np.testing.assert_allclose(np.array([mean.low, mean.high], dtype=float), np.quantile(means, [0.025, 0.975]))
    np.testing.assert_allclose(np.array([median.low, median.high], dtype=float), np.quantile(medians, [0.025, 0.975]))
    assert median.mean == np.median(value)


def test_interval_over_turns_is_that_of_the_percentile_bootstrap() -> None:
    turns = np.random.default_rng(0).exponential(size=(40, 3))
    low, high = interval_over(turns, lambda drawn: drawn.mean(axis=(-2, -1)), resamples=20_000)
    known = scipy.stats.bootstrap((turns.mean(axis=1),), np.mean, n_resamples=20_000, method="percentile", rng=1)
    np.testing.assert_allclose((low, high), known.confidence_interval, atol=0.01)


def test_one_object_has_no_interval() -> None:
    draws = draw_objects(1, resamples=10, generator=np.random.default_rng(0))
    value = mean_value(Sums(np.ones(3), np.ones(3)), np.zeros(3, dtype=int), draws)
    assert value is not None
    assert (value.mean, value.low, value.high, value.count) == (1.0, None, None, 3)
    assert median_value(np.full(3, np.nan), np.zeros(3, dtype=int), draws) is None


def test_intervals_need_terms_of_two_objects() -> None:
    draws, owner = draw_objects(6, resamples=50, generator=np.random.default_rng(0)), np.arange(6)
    for counted in (1, 2):
        count = (owner < counted).astype(float)
        mean = mean_value(Sums(0.3 * count, count), owner, draws)
        median = median_value(np.where(count > 0, 0.3, np.nan), owner, draws)
        assert mean is not None
        assert median is not None
        assert (mean.low is None) == (median.low is None) == (counted == 1)


def test_results_and_records_come_back_equal(tmp_path: Path, records: tuple[EntityRecord, ...]) -> None:
    subject = dataclasses.replace(records[0].subject, protocol="semantic")
    semantic = tuple(
        dataclasses.replace(r, subject=dataclasses.replace(subject, object_id=r.subject.object_id)) for r in records
    )
    found = (Discovery(subject, "take-0", 0, slots=4, matched=2),)
    rows = summarise(records + semantic, found, resamples=20, seed=0)
    results = Results(RUN, rows, found, (Unscored("take-0", 1, "link_0/rim", "rim"),), ("a note",))
    path = tmp_path / "deep" / "results.json"
    write_results(results, path, records=records + semantic)
    assert read_results(path) == results
    again = read_records(records_path(path))
    for one, two in zip(records + semantic, again, strict=True):
        for field in dataclasses.fields(EntityRecord):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))
            assert type(getattr(one, field.name)) is type(getattr(two, field.name))
    assert summarise(again, found, resamples=20, seed=0) == rows
    assert sorted(p.name for p in path.parent.iterdir()) == ["results.json", "results.records.parquet"]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, records: tuple[EntityRecord, ...]) -> None:
    path = tmp_path / "results.json"
    rows = summarise(records, resamples=5, seed=0)
    write_results(Results(RUN, rows), path)
    before = path.read_bytes()
    broken = dataclasses.replace(RUN, seconds=float("nan"))  # JSON has no NaN
    with pytest.raises(ValueError):
        write_results(Results(broken, rows), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


@pytest.mark.parametrize("content", ["", "{}", '{"format": 99}', '{"format": 1, "run": {}}', "[1]"])
def test_damaged_results_name_the_file(tmp_path: Path, content: str) -> None:
    path = tmp_path / "results.json"
    path.write_text(content)
    with pytest.raises(InputError, match=r"results.*results\.json"):
        read_results(path)
    with pytest.raises(InputError, match="records"):
        read_records(path)
    with pytest.raises(InputError, match="expected"):
        read_results(tmp_path / "none.json")
    with pytest.raises(InputError, match=r"ends in \.json"):
        write_results(Results(RUN, ()), tmp_path / "results.txt")


def _text(results: Results, width: int) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(results_table(results, width=width))
    return console.export_text()


def test_the_table_shows_every_row_and_marks_training_objects(records: tuple[EntityRecord, ...]) -> None:
    train = tuple(dataclasses.replace(r, subject=dataclasses.replace(r.subject, part="train")) for r in records)
    results = Results(RUN, summarise(records + train, resamples=20, seed=0), notes=("mind the gap",))
    text = _text(results, 170)
    assert "TRAINING OBJECTS" in text
    assert "validation objects" in text
    assert "mind the gap" in text
    assert text.count("moved") == 2
    for heading in ("APE", "APE_vis", "D@50", "D@100", "Acc %", "switches", "slope", "med px", "APE_px", "APE_2d"):
        assert heading in text
    ape = results.rows[0].metrics.ape
    assert ape is not None
    assert f"{ape.mean:.3f}" in text
    assert f"{ape.low:.3f}–{ape.high:.3f}".replace("0.", ".") in text


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_narrow_table_cuts_no_number(records: tuple[EntityRecord, ...], width: int) -> None:
    text = _text(Results(RUN, summarise(records, resamples=20, seed=0)), width)
    assert "…" not in text
    assert "not shown for want of width" in text.replace("\n", " ")
    assert "APE" in text
    assert all(len(line) <= width for line in text.splitlines())
