"""Pooling, readings, intervals, tables, and the files that keep them."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Iterable
from dataclasses import replace
from operator import itemgetter
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
    Row,
    Unscored,
    read_records,
    read_results,
    results_table,
    summarise,
    write_results,
)
from quest.evaluation.bootstrap import Pool, Value, interval_over
from quest.evaluation.report import provenance, write_report
from quest.evaluation.results import records_path
from quest.evaluation.tables import shown
from tests.evaluation.answers import RUN, known, make_answer, mean


def about(records: Iterable[EntityRecord], **changes: str | int) -> tuple[EntityRecord, ...]:
    """The same answers of another subject."""
    return tuple(replace(r, subject=replace(r.subject, **changes)) for r in records)  # type: ignore[arg-type]


@pytest.fixture
def records() -> tuple[EntityRecord, ...]:
    """Of four objects, of two lengths, some asked for late, not all visible."""
    rng, made = np.random.default_rng(1), []
    for i in range(14):
        frames = 20 if i % 2 else 33
        distance_px = rng.uniform(0, 9, size=frames).astype(np.float32)
        distance_px[i % frames] = np.nan
        answer = make_answer(
            rng.uniform(size=frames),
            object_id=f"box-{i % 4}",
            take=f"take-{i % 5}",
            view=i % 3,
            entity=i % 2,
            moved=i % 3 == 0,
            first_frame=i % 4,
            follows=rng.integers(-1, 2, size=frames),
            visible=rng.uniform(size=frames) > 0.3,
        )
        made.append(replace(answer, distance_px=distance_px))
    return tuple(made)


def text_of(rows: tuple[Row, ...], width: int = 200, notes: tuple[str, ...] = ()) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(results_table(Results(RUN, rows, notes=notes), width=width))
    return console.export_text()


def test_suites_have_rows_and_tables_of_their_own() -> None:
    takes = ("box-1-L1-s000000", "box-1-L1-noise-0-s000000", "box-1-L1-noise-5-s000000", "box-1-L1-occlusion-s000000")
    records = [make_answer([0.1 * i] * 4, take=take) for i, take in enumerate(takes)]
    rows = {row.suite: row for row in summarise(records, resamples=5, seed=0) if row.reading == "all"}
    assert list(rows) == ["noise-0", "noise-5", "occlusion", "standard"]
    assert mean(rows["noise-5"].metrics.ape) == pytest.approx(0.2)
    text = text_of(tuple(rows.values()))
    assert "suite noise-5" in text
    assert "suite standard" not in text


def test_rows_pool_frames_of_records_of_any_length(records: tuple[EntityRecord, ...]) -> None:
    rows = {row.reading: row for row in summarise(records, resamples=30, seed=0)}
    for reading, kept in (("all", records), ("moved", [r for r in records if r.moved])):
        metrics, row = rows[reading].metrics, rows[reading]
        gaps = [r.distance[r.first_frame :] for r in kept]
        seen = [r.distance_px[r.first_frame :][r.visible[r.first_frame :]] for r in kept]
        right = [(r.follows == r.entity)[r.first_frame :] for r in kept]
        assert mean(metrics.ape) == pytest.approx(np.concatenate(gaps).mean())
        assert known(metrics.ape).count == row.frames == sum(map(len, gaps))
        assert mean(metrics.d100) == pytest.approx(np.mean([r.distance[-1] for r in kept]))
        assert mean(metrics.median_px_vis) == pytest.approx(np.nanmedian(np.concatenate(seen)))
        assert mean(metrics.acc) == pytest.approx(np.concatenate(right).mean())
        assert (row.tracks, row.takes) == (len(kept), len({r.take for r in kept}))
        assert row.entities == len({(r.take, r.entity) for r in kept})
        assert row.objects == len({r.subject.object_id for r in kept})
        assert metrics.precision is metrics.recall is None


def test_rows_are_kept_apart_and_do_not_depend_on_each_other(records: tuple[EntityRecord, ...]) -> None:
    alone = summarise(records, resamples=30, seed=0)
    others = (about(records, **change) for change in ({"source": "partnet-mobility"}, {"level": 4}, {"part": "train"}))
    together = summarise(sum(others, records), resamples=30, seed=0)
    assert len(together) == 4 * len(alone)
    assert set(alone) <= set(together)


def test_what_there_is_nothing_of_has_no_rows_and_values(records: tuple[EntityRecord, ...]) -> None:
    still = [replace(r, moved=False, visible=np.zeros_like(r.visible)) for r in records]
    (row,) = summarise(still, resamples=5, seed=0)
    assert row.reading == "all"
    assert row.metrics.ape_vis is row.metrics.median_px_vis is None
    assert row.metrics.ape is not None
    assert summarise((), resamples=5, seed=0) == ()


def test_bootstrap_equals_resampling_the_objects_by_hand() -> None:
    rng = np.random.default_rng(0)
    terms = [(int(o), float(x + o)) for o, x in zip(rng.integers(0, 5, size=60), rng.exponential(size=60), strict=True)]
    pool = Pool(terms, itemgetter(0), resamples=200, seed=3)
    assert (pool.draws.sum(axis=1) == 5).all()
    own = [[x for o, x in terms if o == k] for k in range(5)]
    pooled = [np.concatenate([own[k] * n for k, n in enumerate(drawn)]) for drawn in pool.draws]
    for got, statistic in ((pool.mean(itemgetter(1)), np.mean), (pool.median(itemgetter(1)), np.median)):
        assert mean(got) == pytest.approx(statistic([x for _, x in terms]))
        expected = np.quantile([statistic(each) for each in pooled], [0.025, 0.975])
        np.testing.assert_allclose(np.array([known(got).low, known(got).high], dtype=float), expected)


def test_interval_over_turns_is_that_of_the_percentile_bootstrap() -> None:
    turns = np.random.default_rng(0).exponential(size=(40, 3))
    value = interval_over(turns, lambda drawn: drawn.mean(axis=(-2, -1)), resamples=20_000)
    by_scipy = scipy.stats.bootstrap((turns.mean(axis=1),), np.mean, n_resamples=20_000, method="percentile", rng=1)
    assert (value.mean, value.count) == (pytest.approx(turns.mean()), 40)
    np.testing.assert_allclose(np.array([value.low, value.high], float), by_scipy.confidence_interval, atol=0.01)


def test_intervals_need_terms_of_two_objects() -> None:
    pool = Pool(range(6), lambda record: record, resamples=50, seed=0)
    for counted in (0, 1, 2):
        average = pool.mean(lambda i, n=counted: 0.3 * (i < n), lambda i, n=counted: i < n)
        median = pool.median(lambda i, n=counted: 0.3 if i < n else np.nan)
        if counted:
            assert (known(average).mean, known(average).count) == (pytest.approx(0.3), counted)
            assert (known(average).low is None) == (known(median).low is None) == (counted == 1)
        else:
            assert average is median is None
    alone = Pool([[1.0], [2.0]], resamples=50, seed=0)  # each record is an object of its own
    assert (alone.objects, known(alone.mean(sum)).low) == (2, 1.0)


def test_results_and_records_come_back_equal(tmp_path: Path, records: tuple[EntityRecord, ...]) -> None:
    semantic = about(records, protocol="semantic")
    found = (Discovery(semantic[0].subject, "take-0", 0, slots=4, matched=2),)
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
    with pytest.raises(ValueError, match="JSON"):  # which has no NaN
        write_results(Results(replace(RUN, seconds=float("nan")), rows), path)
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


def test_names_of_results(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected"):
        read_results(tmp_path / "none.json")
    with pytest.raises(InputError, match=r"ends in \.json"):
        write_results(Results(RUN, ()), tmp_path / "results.txt")


def test_the_table_shows_every_row_and_marks_training_objects(records: tuple[EntityRecord, ...]) -> None:
    rows = summarise(records + about(records, part="train"), resamples=20, seed=0)
    text = text_of(rows, 170, ("mind the gap",))
    headings = ("APE", "APE_vis", "D@50", "D@100", "Acc %", "switches", "slope", "med px", "APE_px", "APE_2d")
    assert all(words in text for words in ("TRAINING OBJECTS", "validation objects", "mind the gap", *headings))
    assert text.count("moved") == 2
    ape = known(rows[0].metrics.ape)
    assert f"{ape.mean:.3f}" in text
    assert f"{ape.low:.3f}–{ape.high:.3f}".replace("0.", ".") in text


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_narrow_table_cuts_no_number(records: tuple[EntityRecord, ...], width: int) -> None:
    text = text_of(summarise(records, resamples=20, seed=0), width)
    assert "…" not in text
    assert "not shown for want of width" in text.replace("\n", " ")
    assert "APE" in text
    assert all(len(line) <= width for line in text.splitlines())


def test_reports_carry_how_they_are_made_again(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "report.json"
    write_report(provenance() | {"run": RUN}, path)
    read = json.loads(path.read_text())
    assert read["run"]["commit"] == "abc"
    assert {"command", "commit", "machine", "versions", "stamp"} <= set(read)


def test_records_of_an_earlier_run_do_not_stay(tmp_path: Path) -> None:
    write_results(Results(RUN, ()), tmp_path / "a.json", records=(make_answer(np.zeros(5)),))
    write_results(Results(RUN, ()), tmp_path / "a.json")
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_values_in_the_terminal() -> None:
    value = Value(0.5, 0.25, 0.75, 3)
    assert shown(value, decimals=1, factor=100) == "50.0 (25.0–75.0)"
    assert shown(Value(-0.5, -1.0, None, 3), decimals=1) == "-0.5 (-1.0 to ∞)"
    plain = [shown(each) for each in (Value(0.5, None, None, 3), None, 0.25, 3, "far")]
    assert plain == ["0.500", "-", "0.250", "3", "far"]
