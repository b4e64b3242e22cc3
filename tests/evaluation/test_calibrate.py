"""Fitting the monitor to recorded streams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quest.errors import ConfigError
from quest.evaluation.calibrate import FitConfig, Fitted, fit_calibration
from quest.evaluation.detectors import fit_part, our_monitor, play
from quest.evaluation.drift import auroc, calibration_error
from quest.evaluation.stream_record import StreamRecord
from quest.monitor import Calibration
from quest.monitor.statistic import Cusum
from tests.monitor.calibrations import make_calibrator
from tests.monitor.streams import make_streams

QUICK = FitConfig(folds=3, hidden=(0, 4), decay=(0.1,), epochs=6)


@pytest.fixture(scope="module")
def streams() -> list[StreamRecord]:
    return make_streams(160)


@pytest.fixture(scope="module")
def fitted(streams: list[StreamRecord]) -> Fitted:
    return fit_calibration(streams, config=QUICK)


@pytest.mark.slow
def test_what_is_fitted_holds_on_other_objects(fitted: Fitted):
    """Cross-validated numbers are near those on new objects, and far better than the network's own confidence."""
    test = make_streams(150, first=1000, part="test")
    score = np.concatenate([s.ravel() for s in play(our_monitor(fitted.calibration), test).score])
    lost = np.concatenate([r.lost.ravel() for r in test])
    assert fitted.auroc > 0.93
    assert auroc(score, lost) > 0.93
    assert auroc(score, lost) > auroc(np.concatenate([1 - r.confidence.ravel() for r in test]), lost) + 0.1
    assert fitted.ece < 0.02
    assert calibration_error(score, lost) < 0.02
    assert fitted.delay < 15


def test_thresholds_rest_on_objects_that_nothing_was_fitted_to(streams: list[StreamRecord], fitted: Fitted):
    fit, rest = fit_part(streams)
    assert fitted.objects == len({r.object_id for r in fit})
    assert fitted.frames == sum(r.lost.size for r in fit)
    assert len(fitted.calibration.maxima) == sum(r.loss_free for r in rest)
    assert fitted.calibration.block_frames == 60
    played = play(our_monitor(fitted.calibration), [r for r in rest if r.loss_free])
    np.testing.assert_allclose(fitted.calibration.maxima, np.sort([p.max() for p in played.path]))
    changed = [r if r in fit else replace(r, signals=r.signals + 1) for r in streams]
    again = fit_calibration(changed, config=QUICK).calibration
    np.testing.assert_array_equal(again.calibrator.direct, fitted.calibration.calibrator.direct)


def test_what_is_stored_is_what_thresholds_were_made_with(fitted: Fitted):
    again = Calibration.from_json(fitted.calibration.to_json())
    test = make_streams(3, first=1000)
    for a, b in zip(play(our_monitor(again), test).path, play(our_monitor(fitted.calibration), test).path, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (again.maxima >= fitted.calibration.maxima).all()


def test_the_text_stays_small():
    """As many members and hidden units as the default settings can choose."""
    largest = make_calibrator(hidden=max(FitConfig().hidden), members=FitConfig().folds)
    maxima = np.sort(np.random.default_rng(0).normal(size=500) ** 2)
    assert len(Calibration(largest, Cusum(0.0), maxima, 60, "", 0).to_json()) < 100_000


def test_same_streams_same_monitor(streams: list[StreamRecord], fitted: Fitted):
    assert fit_calibration(streams, config=QUICK).calibration.to_json() == fitted.calibration.to_json()


def test_signals_that_are_never_known(streams: list[StreamRecord]):
    """Recordings without depth lack several signals altogether."""
    blind = []
    for r in streams:
        signals = r.signals.copy()
        signals[..., [7, 8]] = np.nan
        signals[..., 2] = 5.0
        blind.append(replace(r, signals=signals))
    found = fit_calibration(blind, config=replace(QUICK, hidden=(0,)))
    assert found.auroc > 0.8
    assert np.isfinite(found.calibration.maxima).all()


def test_shorter_blocks(streams: list[StreamRecord]):
    found = fit_calibration(streams, config=replace(QUICK, hidden=(0,)), block_frames=20).calibration
    assert found.block_frames == 20
    whole = fit_calibration(streams, config=replace(QUICK, hidden=(0,))).calibration
    assert len(found.maxima) > len(whole.maxima)  # streams that are lost only later count as well


def test_what_does_not_suffice(streams: list[StreamRecord]):
    with pytest.raises(ConfigError, match="validation objects"):
        fit_calibration([*streams, replace(streams[0], part="test")], config=QUICK)
    with pytest.raises(ConfigError, match="none"):
        fit_calibration([], config=QUICK)
    with pytest.raises(ConfigError, match="record more takes"):
        fit_calibration(streams[:3], config=QUICK)
    with pytest.raises(ConfigError, match="record more takes"):
        fit_calibration(make_streams(60, losses=0.0), config=QUICK)
    with pytest.raises(ConfigError, match="folds"):
        FitConfig(folds=1)
