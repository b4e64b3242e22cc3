"""The monitor of one stream."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from quest.errors import ConfigError, InputError
from quest.evaluation.detectors import our_monitor, play
from quest.monitor import Alarm, Calibration, Monitor, MonitorState, Verdict
from quest.monitor.statistic import Cusum
from quest.track.saving import load, save
from tests.monitor.calibrations import share, watching
from tests.monitor.streams import make_stream


def why(row: int) -> str:
    return f"reason of row {row}"


def odds(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def run(monitor: Monitor, values: list[float], *, key: int = 0, first: int = 0) -> list[Verdict]:
    return [monitor.step([key], odds(v), why, frame=first + t, stamp_s=0.1 * t) for t, v in enumerate(values)]


def watched(calibration: Calibration, *keys: int, alpha: float = 0.1) -> Monitor:
    monitor = Monitor(calibration, alpha=alpha)
    for key in keys:
        monitor.watch(key, f"handle {key}")
    return monitor


def test_an_alarm_is_raised_once_and_stays_open():
    monitor = watched(watching(), 0)
    verdicts = run(monitor, [-3.0] * 8 + [3.0] * 12)
    raised = [t for t, v in enumerate(verdicts) if v.raised]
    assert len(raised) == 1
    (alarm,) = verdicts[raised[0]].raised
    assert (alarm.name, alarm.query, alarm.frame) == ("handle 0", 0, raised[0])
    assert alarm.stamp_s == pytest.approx(0.1 * raised[0])
    assert alarm.statistic > alarm.threshold
    assert alarm.alpha == share(0.1, block=1, restart=0)
    assert alarm.reason == "reason of row 0"
    assert all(v.open == (None,) for v in verdicts[: raised[0]])
    assert all(v.open == (alarm,) for v in verdicts[raised[0] :])
    assert monitor.alarm(0) == alarm
    monitor.rename(0, "lid")
    assert monitor.alarm(0) == replace(alarm, name="lid")
    assert (verdicts[-1].lost_p > 0.8).all()
    assert (verdicts[0].lost_p < 0.2).all()


def test_clearing_ends_the_alarm_and_spends_less_each_time():
    monitor = watched(watching(block_frames=1000), 0)
    alarms: list[Alarm] = []
    for j in range(3):
        alarms += [a for v in run(monitor, [3.0] * 15, first=15 * j) for a in v.raised]
        monitor.clear(0)
        assert monitor.alarm(0) is None
    assert [a.alpha for a in alarms] == [share(0.1, block=1, restart=j) for j in range(3)]
    assert alarms[0].threshold < alarms[1].threshold < alarms[2].threshold
    assert [a.extrapolated for a in alarms] == [False] * 3
    run(monitor, [3.0] * 2)
    monitor.clear(0)  # without an alarm this spends nothing
    again = run(monitor, [0.0] * 2 + [3.0] * 15)
    assert again[0].statistic == 0.0
    assert next(a for v in again for a in v.raised).alpha == share(0.1, block=1, restart=3)


def test_restarts_are_counted_over_the_stream():
    """Two queries that both alarm and are cleared spend alpha / 2 and alpha / 4, or their sum would exceed alpha."""
    monitor = watched(watching(block_frames=1000), 0, 1)
    for _ in range(2):
        for t in range(15):
            verdict = monitor.step([0, 1], odds(3.0, 3.0), why, frame=t, stamp_s=0.0)
        found = sorted(a.alpha for a in verdict.open if a is not None)
        monitor.clear(0)
        monitor.clear(1)
    assert found == [share(0.1, block=1, restart=j) for j in (2, 1)]


def test_every_block_starts_from_nothing_and_spends_less():
    calibration = watching(block_frames=6, maxima=np.linspace(0.0, 20.0, 1000))
    monitor = watched(calibration, 0)
    verdicts = run(monitor, [1.5] * 24)
    statistic = np.array([v.statistic[0] for v in verdicts]).reshape(4, 6)
    np.testing.assert_array_equal(statistic, statistic[:1].repeat(4, axis=0))
    assert (np.diff(statistic, axis=1) > 0).all()
    late = watched(calibration, 0)
    raised = [a for v in run(late, [-3.0] * 12 + [5.0] * 6) for a in v.raised]
    assert [a.alpha for a in raised] == [share(0.1, block=3, restart=0)]


def test_alpha_in_so_many_frames_is_spent_again_and_again():
    """No block is less watched than the first, nor is what was cleared."""
    calibration = watching()
    monitor = Monitor(calibration, alpha=0.1, alpha_frames=2 * calibration.block_frames)
    monitor.watch(0, "door")
    alarms = []
    for t in range(5 * calibration.block_frames):
        alarms += monitor.step([0], odds(3.0), why, frame=t, stamp_s=0.0).raised
        if monitor.alarm(0) is not None:
            monitor.clear(0)
    assert len(alarms) > 5
    assert {a.alpha for a in alarms} == {0.05}


@pytest.mark.parametrize("alpha_frames", [None, 40])
def test_blocks_after_a_cleared_alarm(alpha_frames: int | None):
    """They count from there, but are those of the stream where alpha is for so many frames."""
    monitor = Monitor(watching(block_frames=20), alpha=0.1, alpha_frames=alpha_frames)
    monitor.watch(0, "door")
    run(monitor, [3.0] * 12)
    assert monitor.alarm(0) is not None
    monitor.clear(0)
    statistic = [float(v.statistic[0]) for v in run(monitor, [0.1] * 28, first=12)]
    fell = [t for t in range(13, 40) if statistic[t - 12] < statistic[t - 13]]
    assert fell == ([32] if alpha_frames is None else [20])


def test_too_few_streams_raise_no_alarm_and_an_endless_stream_keeps_few_thresholds():
    monitor = watched(watching(maxima=np.linspace(0.0, 1.0, 5)), 0, alpha=0.01)
    assert not any(v.raised for v in run(monitor, [8.0] * 50))
    monitor = watched(watching(block_frames=1, maxima=np.linspace(0.0, 20.0, 1000)), 0)
    run(monitor, [-1.0] * 1100)
    assert len(monitor._thresholds) <= 1001


def test_queries_come_and_go():
    """Whatever the others do, a query's verdicts are those it would have alone."""
    calibration = watching(statistic=Cusum(-3.0), maxima=np.linspace(0, 50, 100), block_frames=15)
    record = make_stream(3, frames=40, queries=3)
    together, alone = watched(calibration, 0, 2), watched(calibration, 2)
    for t in range(40):
        if t == 10:
            together.watch(1, "late")
        if t == 25:
            together.forget(0)
        keys = [k for k in (1, 0, 2) if (k != 1 or t >= 10) and (k != 0 or t < 25)]
        all_of = together.step(keys, record.log_odds[t, keys], why, frame=t, stamp_s=0.0)
        one = alone.step([2], record.log_odds[t, [2]], why, frame=t, stamp_s=0.0)
        assert all_of.lost_p[-1] == pytest.approx(one.lost_p[0], abs=1e-6)
        assert all_of.statistic[-1] == pytest.approx(one.statistic[0], rel=1e-6)
    assert together.alarm(0) is None


def test_who_is_not_answered_or_has_no_log_odds_rests():
    """But begins from nothing where a block begins."""
    monitor = watched(watching(maxima=np.linspace(0.0, 1000.0, 1000)), 0, 1)
    for t in range(24):
        keys = [0, 1] if t not in (3, 20) else [0]
        last = monitor.step(keys, odds(*[1.0] * len(keys)), why, frame=t, stamp_s=0.0)
        if t == 4:
            assert last.statistic.tolist() == [5.0, 4.0]
    assert last.statistic.tolist() == [4.0, 3.0]
    monitor = watched(watching(), 0)
    run(monitor, [1.0, 1.0])
    for v in run(monitor, [np.nan] * 5, first=2):
        assert np.isnan(v.lost_p).all()
        assert v.statistic == [2.0]
        assert not v.raised
    assert run(monitor, [1.0], first=7)[0].statistic == [3.0]
    assert np.isfinite(run(monitor, [np.inf, -np.inf])[-1].statistic).all()


def test_an_alarm_ends_when_its_statistic_is_zero_again():
    """However long the loss lasted; as if it were cleared then."""
    monitors = [watched(watching(block_frames=1000), 0) for _ in range(2)]
    ends = []
    for monitor, frames in zip(monitors, (10, 300), strict=True):
        lost = run(monitor, [3.0] * frames)
        (alarm,) = [a for v in lost for a in v.raised]
        after = run(monitor, [-3.0] * 10, first=frames)
        ends.append(next(t for t, v in enumerate(after) if v.cleared))
        assert [a for v in after for a in v.cleared] == [alarm]
        assert all(v.open == (alarm,) for v in after[: ends[-1]])
        assert all(v.open == (None,) for v in after[ends[-1] :])
        again = next(a for v in run(monitor, [3.0] * 10) for a in v.raised)
        assert again.alpha == share(0.1, block=1, restart=1)
    assert ends == [3, 3]  # 9.2 / 3 frames


def test_what_ends_no_alarm():
    monitor = watched(watching(), 0)
    run(monitor, [3.0] * 10)
    assert monitor.alarm(0) is not None
    monitor.switch(watching())
    assert not any(v.cleared for v in run(monitor, [np.nan] * 5)), "no log odds"
    assert run(monitor, [-1.0])[0].cleared
    verdicts = run(watched(watching(maxima=np.zeros(100)), 0), [-1.0, 1.0, 1.0, 1.0, -1.0])
    assert [(len(v.raised), len(v.cleared)) for v in verdicts] == [(0, 0), (1, 0), (0, 0), (0, 0), (0, 1)]
    verdicts = run(watched(watching(block_frames=5), 0), [5.0] * 4 + [-1.0] * 3)
    assert not any(v.cleared for v in verdicts), "a block that begins"
    assert verdicts[-1].open != (None,)


def test_another_calibration():
    """Statistics begin anew with less of alpha, and open alarms stay."""
    monitor = watched(watching(block_frames=1000), 0, 1)
    for t in range(4):
        monitor.step([0, 1], odds(3.0, 1.0), why, frame=t, stamp_s=0.0)
    alarm = monitor.alarm(0)
    assert alarm is not None
    monitor.switch(watching(slope=2.0, block_frames=500))
    verdict = monitor.step([0, 1], odds(1.0, 1.0), why, frame=4, stamp_s=0.0)
    np.testing.assert_allclose(verdict.statistic, 2.0)
    assert verdict.open == (alarm, None)
    (raised,) = [a for t in range(5) for a in monitor.step([1], odds(4.0), why, frame=5 + t, stamp_s=0.0).raised]
    assert raised.alpha == share(0.1, block=1, restart=1)
    fresh = watched(watching(), 0)
    fresh.switch(watching())  # nothing is spent before the first frame
    assert next(a for v in run(fresh, [3.0] * 5) for a in v.raised).alpha == share(0.1, block=1, restart=0)


def test_a_restored_monitor_goes_on_as_if_nothing_had_happened():
    calibration = watching(statistic=Cusum(-3.5), maxima=np.linspace(0, 5, 100), block_frames=15)
    record = make_stream(5, frames=60, queries=3)
    monitor = watched(calibration, 0, 1, 2)
    restored = None
    for t in range(60):
        if t == 20:
            monitor.clear(1)
        if t == 30:
            restored = Monitor(calibration, alpha=0.1)
            restored.state = load(save(monitor.state), MonitorState)
        verdict = monitor.step([0, 1, 2], record.log_odds[t], why, frame=t, stamp_s=0.1 * t)
        if restored is not None:
            again = restored.step([0, 1, 2], record.log_odds[t], why, frame=t, stamp_s=0.1 * t)
            np.testing.assert_array_equal(again.lost_p, verdict.lost_p)
            np.testing.assert_array_equal(again.statistic, verdict.statistic)
            assert (again.open, again.raised, again.cleared) == (verdict.open, verdict.raised, verdict.cleared)
    assert restored is not None
    assert any(verdict.open)
    assert save(restored.state) == save(monitor.state)


@pytest.mark.plain  # where types are checked such numbers are refused
def test_alarms_of_numbers_of_numpy_are_saved():
    calibration = watching()
    numbers: Any = np.float32, np.int64
    real, whole = numbers
    monitor, again = (Monitor(calibration, alpha=real(0.1), alpha_frames=whole(40)) for _ in range(2))
    monitor.watch(0, "door")
    for t in range(15):
        monitor.step([0], odds(3.0), why, frame=whole(t), stamp_s=real(t))
    again.state = load(save(monitor.state), MonitorState)
    assert monitor.alarm(0) is not None
    assert again.alarm(0) == monitor.alarm(0)


def test_replaying_records_gives_what_the_monitor_gives():
    calibration = watching(
        slope=0.7, shift=0.3, statistic=Cusum(-3.0, 0.9), maxima=np.linspace(90, 100, 100), block_frames=25
    )
    records = [make_stream(1, frames=60), make_stream(2, frames=30, queries=2), make_stream(3, frames=60)]
    records[2] = replace(records[2], asked=np.array([0, 7, 0, 40]))
    played = play(our_monitor(calibration), records)
    for i, record in enumerate(records):
        monitor = Monitor(calibration, alpha=0.05)
        for t in range(len(record)):
            for k in np.flatnonzero(record.asked == t):
                monitor.watch(int(k), f"{k}")
            keys = [int(k) for k in np.flatnonzero(record.asked <= t)]
            verdict = monitor.step(keys, record.log_odds[t, keys], why, frame=t, stamp_s=0.0)
            np.testing.assert_allclose(played.score[i][t, keys], verdict.lost_p, atol=1e-5)
            np.testing.assert_allclose(played.path[i][t, keys], verdict.statistic, rtol=1e-4, atol=1e-5)


def test_misuse_is_named():
    with pytest.raises(ConfigError, match="alpha"):
        Monitor(watching(), alpha=1.0)
    monitor = Monitor(watching(), alpha=0.1)
    assert monitor.step([], odds(), why, frame=0, stamp_s=0.0).open == ()
    monitor.watch(0, "handle")
    with pytest.raises(InputError, match="already"):
        monitor.watch(0, "again")
    for call in (monitor.forget, monitor.clear, lambda key: monitor.rename(key, "x")):
        with pytest.raises(InputError, match=r"watch\(7"):
            call(7)
    with pytest.raises(InputError, match="log odds of each query"):
        monitor.step([0], odds(0.0, 0.0), why, frame=0, stamp_s=0.0)
    monitor.watch(1, "other")
    with pytest.raises(InputError, match="log odds of each query"):
        monitor.step([0, 0], odds(0.0, 0.0), why, frame=0, stamp_s=0.0)
    with pytest.raises(InputError, match="watch"):
        monitor.step([5], odds(0.0), why, frame=0, stamp_s=0.0)
