"""Two trackers on the same frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.grounding import MARGIN, Compared, compare, pair_up, seen_around
from quest.errors import InputError
from quest.evaluation import EntityRecord
from quest.evaluation.take_suite import TakeSuite
from tests.evaluation.answers import make_answer

SETTINGS = {"on": "quest", "off": "without", "resamples": 200, "seed": 0}


def both(on: np.ndarray, off: np.ndarray, **about) -> list[EntityRecord]:
    return [make_answer(on, tracker="quest", **about), make_answer(off, tracker="without", **about)]


@pytest.mark.parametrize(
    ("take", "suite", "alike"),
    [
        ("desk-102015-L1-occlusion60alike-s000000", "occlusion", True),
        ("7167-L1-occlusion60-s000012", "occlusion", False),
        ("7167-L2-occlusion-s000000", "occlusion", False),
        ("7167-L2-occlusionalike-s000000", "occlusion", True),
        ("locker_bank-103000-L4-lockers30-s000000", "lockers", False),
        ("lockers-102002-L1-s000000", "standard", False),
        ("panels-0", "standard", False),
    ],
)
def test_suite_of_a_take(take: str, suite: str, alike: bool):
    assert TakeSuite.of(take) == TakeSuite(suite, alike)


@pytest.mark.parametrize(
    ("take", "suite", "variant"),
    [
        ("chest-12-L1-shift-blur-s000000", "shift", "blur"),
        ("chest-12-L2-noise-structured-light-s000003", "noise", "structured-light"),
        ("chest-12-L1-noise-5-s000000", "noise", "5"),
        ("chest-12-L1-gripper-s000000", "gripper", ""),
    ],
)
def test_variant_of_a_take(take: str, suite: str, variant: str):
    assert TakeSuite.of(take) == TakeSuite(suite, False, variant)


def test_seen_around():
    visible = np.array([1, 1, 1, 1, 0, 1, 1, 1, 1, 1], bool)
    np.testing.assert_array_equal(seen_around(visible), [1, 1, 0, 0, 0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(seen_around(np.ones(2, bool)), [1, 1])


def test_means_ratio_and_difference_equal_a_plain_loop():
    rng = np.random.default_rng(0)
    records, on_all, off_all, seen, well = [], [], [], [], []
    for i in range(8):
        frames, first = 20 + 5 * (i % 2), i % 3
        on, off = rng.uniform(0, 0.3, frames).astype(np.float32), rng.uniform(0, 0.3, frames).astype(np.float32)
        visible = rng.random(frames) > 0.15
        follows = np.where(rng.random(frames) > 0.2, 1, -1)
        about = {"object_id": f"desk-{i % 4}", "take": f"t{i}", "first_frame": first, "visible": visible}
        records += [
            make_answer(on, tracker="quest", **about),
            make_answer(off, tracker="without", follows=follows, **about),
        ]
        for t in range(first, frames):
            on_all.append(on[t])
            off_all.append(off[t])
            seen.append(visible[t])
            around = visible[max(t - 2, 0) : t + 3].all()
            well.append(around and follows[t] == 1)
    a, b, seen, well = np.array(on_all, float), np.array(off_all, float), np.array(seen), np.array(well)
    (row,) = compare(records, **SETTINGS)
    for got, kept in ((row.ape, seen | True), (row.visible, seen), (row.well_seen, well)):
        assert got.on is not None
        assert got.off is not None
        assert got.ratio is not None
        assert got.difference is not None
        assert got.on.mean == pytest.approx(a[kept].mean())
        assert got.off.mean == pytest.approx(b[kept].mean())
        assert got.ratio.mean == pytest.approx(a[kept].mean() / b[kept].mean())
        assert got.difference.mean == pytest.approx((a - b)[kept].mean())
        assert got.on.count == got.ratio.count == got.difference.count == kept.sum()
    assert row.worse is not None
    assert row.better is not None
    assert row.worse.mean == pytest.approx((a - b > MARGIN)[well].mean())
    assert row.better.mean == pytest.approx((b - a > MARGIN)[well].mean())
    assert (row.objects, row.takes, row.tracks) == (4, 8, 8)


def test_differences_are_resampled_together():
    """Objects differ much, trackers little: only a paired interval is narrow."""
    rng = np.random.default_rng(1)
    records = []
    for i in range(10):
        off = np.full(12, 0.1 * (i + 1), np.float32)
        records += both(off * 0.9 + rng.normal(0, 1e-4, 12), off, object_id=f"desk-{i}")
    (row,) = compare(records, **SETTINGS)
    assert row.well_seen.ratio is not None
    assert row.ape.on is not None
    assert row.well_seen.ratio.low == pytest.approx(0.9, abs=1e-3)
    assert row.well_seen.ratio.high == pytest.approx(0.9, abs=1e-3)
    assert (row.ape.on.high or 0) - (row.ape.on.low or 0) > 0.2
    assert row.verdict == "not higher"


@pytest.mark.parametrize(("shift", "verdict"), [(0.05, "higher"), (-0.05, "not higher"), (0.0, "not higher")])
def test_verdict(shift: float, verdict: str):
    records = []
    for i in range(6):
        records += both(np.full(10, 0.2 + shift), np.full(10, 0.2), object_id=f"desk-{i}")
    assert compare(records, **SETTINGS)[0].verdict == verdict
    assert compare(records[:-2], **SETTINGS)[0].verdict == "undecided"  # five objects are too few


def test_one_bad_object_is_undecided_and_named():
    records = both(np.full(10, 0.9), np.full(10, 0.2), object_id="desk-bad")
    for i in range(5):
        records += both(np.full(10, 0.1), np.full(10, 0.2), object_id=f"desk-{i}")
    (row,) = compare(records, **SETTINGS)
    assert row.verdict == "undecided"
    assert row.worst_object == "desk-bad"
    assert row.worst_difference == pytest.approx(0.7)
    assert row.worse is not None
    assert row.worse.mean == pytest.approx(1 / 6)


def test_nothing_well_seen():
    records = both(np.full(10, 0.1), np.full(10, 0.2), visible=np.zeros(10, bool))
    (row,) = compare(records, **SETTINGS)
    assert row.well_seen == Compared(None, None, None, None)
    assert (row.verdict, row.worst_object, row.worse) == ("undecided", None, None)
    assert row.ape.on is not None


def test_rows_are_kept_apart():
    still = both(np.ones(9), np.ones(9), take="still", moved=False)
    plain = both(np.ones(9), np.ones(9))
    four = both(np.ones(9), np.ones(9), level=4)
    alike = both(np.ones(9), np.ones(9), take="desk-102015-L1-occlusion60alike-s000000")
    rows = compare([*still, *plain, *four, *alike, make_answer(np.ones(9), tracker="lk")], **SETTINGS)
    assert [(r.level, r.suite, r.tracks) for r in rows] == [(1, "occlusion", 1), (1, "standard", 1), (4, "standard", 1)]
    assert compare(still, **SETTINGS) == ()


def test_protocols_that_only_one_tracker_has_are_left_out():
    extra = make_answer(np.ones(9), protocol="semantic")
    assert len(pair_up([*both(np.ones(9), np.ones(9)), extra], on="quest", off="without")) == 1


def test_what_cannot_be_paired():
    on, off = both(np.ones(9), np.ones(9))
    with pytest.raises(InputError, match="only one of them"):
        pair_up([on, off, make_answer(np.ones(9), take="other")], on="quest", off="without")
    with pytest.raises(InputError, match="--trackers quest without"):
        pair_up([on], on="quest", off="without")
    with pytest.raises(InputError, match="different frames"):
        pair_up([on, replace(off, first_frame=2)], on="quest", off="without")
