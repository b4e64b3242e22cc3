"""Metrics of drift detection against plain loops, and the rows that come of them."""

from __future__ import annotations

import io
import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from quest.errors import ConfigError
from quest.evaluation.detectors import (
    Detector,
    choose,
    doubt,
    fit_part,
    loss_free_maxima,
    one_per_object,
    our_monitor,
    replay_statistic,
    rivals,
)
from quest.evaluation.drift import (
    BINS,
    DEADLINE_FRAMES,
    augrc,
    auroc,
    calibration_error,
    clopper_pearson,
    delay_of,
    losses,
    quantile,
)
from quest.evaluation.drift_report import TABLE_WIDTH, drift_rows, drift_table, parts_of, write_drift
from quest.evaluation.stream_record import LOST, RIGHT, UNCLEAR, StreamRecord
from quest.monitor import Budget
from quest.monitor.statistic import Cusum, Latest
from tests.evaluation.answers import RUN, known, mean
from tests.monitor.calibrations import share, watching
from tests.monitor.streams import make_stream, make_streams


@pytest.fixture
def scored() -> tuple[np.ndarray, np.ndarray]:
    """Scores with ties, and which frames are lost."""
    rng = np.random.default_rng(0)
    lost = rng.random(200) < 0.2
    return np.round(rng.random(200) * 0.6 + 0.4 * lost * rng.random(200), 1), lost


def stream(lost: list[str], *, seed: int = 0, **changes: object) -> StreamRecord:
    """A stream in which each query is lost where its text has an x, and unclear where it has a question mark."""
    record = make_stream(seed, frames=len(lost[0]), queries=len(lost))
    band = np.array([[{".": RIGHT, "?": UNCLEAR, "x": LOST}[c] for c in text] for text in lost], np.int8).T
    return replace(record, band=band, **changes)  # type: ignore[arg-type]


def test_auroc(scored: tuple[np.ndarray, np.ndarray]):
    score, lost = scored
    pairs = [(a > b) + 0.5 * (a == b) for a in score[lost] for b in score[~lost]]
    assert auroc(score, lost) == pytest.approx(np.mean(pairs))
    assert math.isnan(auroc(score, np.zeros(200, bool)))


def test_augrc(scored: tuple[np.ndarray, np.ndarray]):
    """Mean over orders of tied frames of the area under (coverage, accepted and lost) by trapezoids."""
    score, lost = scored
    areas = []
    rng = np.random.default_rng(1)
    for _ in range(3000):
        order = np.lexsort((rng.random(200), score))
        risk = np.concatenate([[0.0], np.cumsum(lost[order])]) / 200
        areas.append(((risk[1:] + risk[:-1]) / 2).mean())
    assert augrc(auroc(score, lost), lost.mean()) == pytest.approx(np.mean(areas), rel=2e-3)


def test_calibration_error(scored: tuple[np.ndarray, np.ndarray]):
    p, lost = scored
    expected = 0.0
    for b in range(BINS):
        within = [i for i in range(200) if min(int(p[i] * BINS), BINS - 1) == b]
        if within:
            expected += len(within) / 200 * abs(np.mean(p[within]) - np.mean(lost[within]))
    assert calibration_error(p, lost) == pytest.approx(expected)
    assert calibration_error(np.array([0.0, 1.0]), np.array([False, True])) == 0.0


def test_clopper_pearson():
    assert clopper_pearson(0, 10) == pytest.approx((0.0, 0.3085), abs=1e-4)
    assert clopper_pearson(10, 10) == pytest.approx((0.6915, 1.0), abs=1e-4)
    assert clopper_pearson(5, 100) == pytest.approx((0.0164, 0.1128), abs=1e-4)


def test_quantile_counts_what_is_infinite():
    value = np.array([3.0, math.inf, 1.0, 2.0])
    assert [quantile(value, share) for share in (0.25, 0.5, 0.75, 0.9)] == [1.0, 2.0, 3.0, math.inf]
    assert quantile(value, 0.5, np.array([3.0, 0.0, 1.0, 0.0])) == 3.0
    assert math.isnan(quantile(value, 0.5, np.zeros(4)))


def test_losses_and_delays():
    """At 30 frames per second half a second has 15 frames."""
    late, short, brief = "." * 46 + "x" * 14, "." * 10 + "x" * 15 + "." * 35, "." * 10 + "x" * 14 + "." * 36
    twice = "." * 3 + "xx" + "?" * 2 + "x" * 48 + "." * 5
    record = stream([late, short, "." * 60, twice, brief])
    found = {loss.query: loss for loss in losses(record)}
    assert sorted(found) == [0, 1, 3, 4]
    assert [found[k].lasts for k in sorted(found)] == [False, True, True, False]
    assert (found[1].first, found[1].start, found[1].deadline) == (10, 10, 10 + DEADLINE_FRAMES)
    assert (found[3].first, found[3].start, found[3].deadline) == (3, 7, 55)  # the loss is longer than the deadline
    above = np.zeros(60, bool)
    assert delay_of(found[1], above) == math.inf
    above[[2, 14, 15]] = True
    assert delay_of(found[1], above) == 4.0  # the alarm before the loss does not count
    above[:] = np.arange(60) >= 10 + DEADLINE_FRAMES
    assert delay_of(found[1], above) == math.inf
    assert delay_of(found[3], above) == 33.0


def test_frames_before_a_query_do_not_count():
    record = stream(["xxx" + "." * 27], asked=np.array([3]))
    assert record.loss_free
    assert not losses(record)


def test_objects_are_parted_by_their_names_alone():
    records = make_streams(200)
    fit, rest = fit_part(records)
    assert not {r.object_id for r in fit} & {r.object_id for r in rest}
    assert len(fit) + len(rest) == 200
    assert 60 < len(fit) < 100
    assert [r.object_id for r in fit_part(records[50:120])[0]] == [r.object_id for r in fit if r in records[50:120]]


def test_one_stream_per_object_is_drawn_without_looking():
    records = [replace(make_stream(o), object_id=f"object-{o}", view=v) for o in range(20) for v in range(3)]
    drawn = one_per_object(records)
    assert [records[i].object_id for i in drawn] == [f"object-{o}" for o in range(20)]
    assert len({records[i].view for i in drawn}) == 3
    turned = one_per_object([replace(r, band=LOST - r.band) for r in records])
    assert turned == drawn


def test_maxima_are_of_loss_free_streams_that_are_long_enough():
    records = [stream(["." * 30]), stream(["." * 30], seed=1), stream(["." * 20], seed=2), stream(["x" * 30], seed=3)]
    records.append(stream(["." * 25 + "x" * 5], seed=4))
    evidence = [np.arange(len(r), dtype=float)[:, None] * (i + 1) for i, r in enumerate(records)]
    maxima = loss_free_maxima(Latest(), records, evidence, block_frames=25)
    np.testing.assert_array_equal(maxima, [24.0, 48.0, 120.0])  # the last one is lost only after the block
    with pytest.raises(ConfigError, match="loss-free"):
        loss_free_maxima(Latest(), records[3:], evidence[3:], block_frames=30)


def test_what_has_no_log_odds_changes_no_statistic():
    record = stream(["." * 12])
    evidence = np.ones((12, 1))
    evidence[[2, 3, 9]] = np.nan
    (path,) = replay_statistic(Cusum(0.0), [evidence], [record], block_frames=6)
    np.testing.assert_array_equal(path[:, 0], [1, 2, 2, 2, 3, 4, 1, 2, 3, 3, 4, 5])


def test_the_soonest_statistic_is_chosen():
    records = [stream(["." * 40], seed=s) for s in range(40)] + [
        stream(["." * 20 + "x" * 20], seed=s) for s in range(9)
    ]
    rng = np.random.default_rng(0)
    evidence = [rng.normal(size=r.band.shape) + 1.5 * r.lost for r in records]
    best, delays = choose([Latest(), Cusum(0.7), Cusum(50.0)], evidence, records, block_frames=40)
    assert best == Cusum(0.7)
    assert delays[1] < min(delays[0], delays[2])
    assert delays[2] == 30 if math.isinf(delays[2]) else delays[2] <= 30
    with pytest.raises(ConfigError, match="losses"):
        choose([Latest()], evidence[:5], records[:5], block_frames=40)


@pytest.fixture(scope="module")
def detectors() -> tuple[Detector, ...]:
    return (our_monitor(watching(block_frames=60)), *rivals(make_streams(120), block_frames=60))


def test_rows(detectors: tuple[Detector, ...]):
    records = make_streams(60, first=1000, part="test")
    records += [replace(r, source="partnet-mobility") for r in make_streams(30, first=2000, part="test")]
    rows = drift_rows(detectors, records, budgets=(Budget(0.05), Budget(0.3)), resamples=20, seed=0)
    assert [(r.source, r.detector) for r in rows] == list(
        itertools.product(("partnet-mobility", "procedural"), ("monitor", "cusum", "page-hinkley", "threshold"))
    )
    for row in rows:
        group = [r for r in records if r.source == row.source]
        assert (row.part, row.objects, row.streams) == ("test", len(group), len(group))
        assert row.frames + row.unclear_frames == sum(r.band.size for r in group)
        assert row.unclear_frames == sum((r.band == UNCLEAR).sum() for r in group)
        assert row.lost_frames == sum(r.lost.sum() for r in group)
        assert row.losses + row.brief == sum(len(losses(r)) for r in group)
        area = known(row.auroc)
        assert 0.4 < (area.low or 0) <= area.mean <= (area.high or 2) <= 1
        assert (row.ece is None) == (row.detector in ("cusum", "page-hinkley"))
        for alarm in row.alarms:
            assert alarm.trials == alarm.all_trials == sum(r.loss_free for r in group)
            assert alarm.unclear_trials == sum(r.loss_free and not r.right.all() for r in group)
            assert alarm.unclear_false_alarms <= min(alarm.false_alarms, alarm.unclear_trials)
            assert alarm.low is not None
            assert alarm.high is not None
            assert alarm.low <= alarm.false_alarms / alarm.trials <= alarm.high
        assert row.alarms[0].false_alarms <= row.alarms[1].false_alarms
        assert mean(row.alarms[0].missed) >= mean(row.alarms[1].missed)
    threshold = next(r for r in rows if r.detector == "threshold")
    own = [r for r in records if r.source == "partnet-mobility"]
    score, lost = (np.concatenate([of(r)[r.judged] for r in own]) for of in (doubt, lambda r: r.lost))
    assert mean(threshold.auroc) == pytest.approx(auroc(score, lost))


def test_losses_of_one_object_alone_have_no_interval(detectors: tuple[Detector, ...]):
    records = [stream(["." * 60], seed=i, part="test") for i in range(8)]
    records[3] = stream(["." * 20 + "x" * 40], seed=3, part="test")
    (row, *_) = drift_rows(detectors, records, budgets=(Budget(0.3),), resamples=20, seed=0)
    missed = known(row.alarms[0].missed)
    assert (row.losses, missed.low, missed.high) == (1, None, None)


def test_false_alarms_keep_the_promise():
    """No detector alarms on more new loss-free streams than one block may spend of alpha, nor on far fewer."""
    most = share(0.2, block=1, restart=0)
    streams = make_streams(1500, losses=0.0, queries=2, frames=40)
    lossy = make_streams(60, first=5000, queries=2, frames=40, losses=1.0)
    rows = drift_rows(
        rivals(streams[:1200] + lossy, block_frames=40),
        [replace(r, part="test") for r in streams[1200:]],
        budgets=(Budget(0.2),),
        resamples=2,
        seed=0,
    )
    for row in rows:
        assert row.alarms[0].trials == 300
        assert row.alarms[0].low is not None
        assert row.alarms[0].high is not None
        assert row.alarms[0].low <= most
        assert row.alarms[0].high >= most / 2
        assert row.alarms[0].missed is row.auroc is None


@pytest.mark.slow
def test_false_alarms_in_so_many_frames_keep_the_promise():
    """Alpha is for 40 frames, streams have 120: any part of a stream alarms as rarely as the first.

    The promise is of the mean over calibrations, each of which is a little off: here of four, with streams of their
    own. Three standard deviations of the mean, of thresholds and streams together, are 0.055.
    """
    false, trials = {}, {}
    for first in range(0, 40_000, 10_000):
        known = make_streams(400, first=first, losses=0.0, queries=2, frames=120)
        lossy = make_streams(60, first=first + 1000, queries=2, frames=120, losses=1.0)
        new = make_streams(200, first=first + 2000, losses=0.0, queries=2, frames=120, part="test")
        detectors = rivals([*known, *lossy], block_frames=40)
        for row in drift_rows(detectors, new, budgets=[Budget(0.2, 40)], resamples=2, seed=0):
            (alarm,) = row.alarms
            assert (alarm.alpha_frames, alarm.trials, alarm.all_trials) == (40, 200, 600)
            false[row.detector] = false.get(row.detector, 0) + alarm.all_false_alarms
            trials[row.detector] = trials.get(row.detector, 0) + alarm.all_trials
    for detector, count in false.items():
        assert 0.1 < count / trials[detector] < 0.255, detector


@pytest.mark.parametrize(
    ("frames", "each", "parts"),
    [(60, None, [(0, 60)]), (130, 60, [(0, 60), (60, 120)]), (120, 60, [(0, 60), (60, 120)]), (50, 60, [(0, 50)])],
)
def test_parts_are_whole(frames: int, each: int | None, parts: list[tuple[int, int]]):
    """What is left at the end alarms less often, and would make false alarms look rarer."""
    assert parts_of(frames, each) == parts


def test_parts_after_a_loss_are_no_trials():
    record = make_streams(1, losses=0.0, frames=100)[0]
    band = record.band.copy()
    band[50:60, 0] = LOST
    rows = drift_rows(
        rivals(make_streams(120, frames=100), block_frames=40),
        [replace(record, band=band, part="test")],
        budgets=[Budget(0.2, 40), Budget(0.2)],
        resamples=2,
        seed=0,
    )
    assert [a.all_trials for a in rows[0].alarms] == [1, 0]


def test_file_and_table(detectors: tuple[Detector, ...], tmp_path: Path):
    rows = drift_rows(
        detectors, make_streams(20, first=1000, part="test"), budgets=(Budget(0.001), Budget(0.1)), resamples=5, seed=0
    )
    path = tmp_path / "deep" / "drift.json"
    write_drift(rows, RUN, "about", path)
    raw = json.loads(path.read_text())
    assert raw["run"]["commit"] == "abc"
    assert raw["rows"][0]["alarms"][0]["extrapolated"] is True
    assert raw["rows"][0]["auroc"]["mean"] == pytest.approx(mean(rows[0].auroc))
    assert not list(path.parent.glob(".*"))
    shown = io.StringIO()
    Console(width=TABLE_WIDTH, file=shown).print(drift_table(rows))
    text = shown.getvalue()
    assert all(detector.name in text for detector in detectors)
    assert "~0.1" in text
