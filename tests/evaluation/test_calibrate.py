"""Fitting the monitor to recorded streams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quest.errors import ConfigError
from quest.evaluation.calibrate import Fitted, fit_calibration
from quest.evaluation.detectors import fit_part, our_monitor, play
from quest.evaluation.drift import auroc, calibration_error
from quest.evaluation.stream_record import UNCLEAR, StreamRecord
from quest.monitor import Calibration
from tests.monitor.streams import make_streams


@pytest.fixture(scope="module")
def streams() -> list[StreamRecord]:
    return make_streams(160)


@pytest.fixture(scope="module")
def fitted(streams: list[StreamRecord]) -> Fitted:
    return fit_calibration(streams)


def test_what_is_fitted_holds_on_other_objects(fitted: Fitted):
    """Cross-validated numbers are near those on new objects, and probabilities far better than the tracker's own."""
    test = make_streams(150, first=1000, part="test")
    lost = np.concatenate([r.lost[r.judged] for r in test])

    def error(records: list[StreamRecord]) -> float:
        score = play(our_monitor(fitted.calibration), records).score
        return calibration_error(np.concatenate([s[r.judged] for s, r in zip(score, test, strict=True)]), lost)

    assert fitted.auroc > 0.85
    assert auroc(np.concatenate([r.log_odds[r.judged] for r in test]), lost) == pytest.approx(fitted.auroc, abs=0.05)
    assert fitted.ece < 0.03
    assert error(test) < 0.03
    assert error([replace(r, log_odds=r.log_odds + 3) for r in test]) > 0.1
    assert fitted.delay < 20


@pytest.mark.parametrize(("times", "plus"), [(1.0, 2.0), (0.5, 0.0), (3.0, -4.0)])
def test_another_scale_of_log_odds_is_found(streams: list[StreamRecord], fitted: Fitted, times: float, plus: float):
    scaled = fit_calibration([replace(r, log_odds=times * r.log_odds + plus) for r in streams]).calibration
    slope, shift = fitted.calibration.slope, fitted.calibration.shift
    assert scaled.slope * times == pytest.approx(slope, abs=0.01)
    assert scaled.shift == pytest.approx(shift - slope * plus / times, abs=0.05)


def test_thresholds_rest_on_objects_that_nothing_was_fitted_to(streams: list[StreamRecord], fitted: Fitted):
    fit, rest = fit_part(streams)
    assert fitted.objects == len({r.object_id for r in fit})
    assert fitted.frames == sum(r.judged.sum() for r in fit) < sum(r.band.size for r in fit)
    assert len(fitted.calibration.maxima) == sum(r.loss_free for r in rest)
    assert fitted.calibration.block_frames == 60
    played = play(our_monitor(fitted.calibration), [r for r in rest if r.loss_free])
    np.testing.assert_allclose(fitted.calibration.maxima, np.sort([p.max() for p in played.path]))
    changed = [r if r in fit else replace(r, log_odds=r.log_odds + 1) for r in streams]
    again = fit_calibration(changed).calibration
    assert (again.slope, again.shift) == (fitted.calibration.slope, fitted.calibration.shift)


def test_unclear_frames_fit_nothing(streams: list[StreamRecord], fitted: Fitted):
    wild = [replace(r, log_odds=np.where(r.band == UNCLEAR, 9.0, r.log_odds).astype(np.float32)) for r in streams]
    again = fit_calibration(wild)
    assert (again.calibration.slope, again.calibration.shift) == (fitted.calibration.slope, fitted.calibration.shift)
    assert (again.auroc, again.ece) == (fitted.auroc, fitted.ece)


def test_what_is_stored_is_what_thresholds_were_made_with(fitted: Fitted):
    again = Calibration.from_json(fitted.calibration.to_json())
    test = make_streams(3, first=1000)
    for a, b in zip(play(our_monitor(again), test).path, play(our_monitor(fitted.calibration), test).path, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (again.maxima >= fitted.calibration.maxima).all()


def test_shorter_blocks(streams: list[StreamRecord], fitted: Fitted):
    found = fit_calibration(streams, block_frames=20).calibration
    assert found.block_frames == 20
    assert len(found.maxima) > len(fitted.calibration.maxima)  # streams that are lost only later count as well


def test_what_does_not_suffice(streams: list[StreamRecord]):
    for records, match in (
        ([*streams, replace(streams[0], part="test")], "validation objects"),
        ([], "none"),
        ([*streams, replace(streams[0], inputs="colours")], "got both"),
        (streams[:3], "record more takes"),
        (make_streams(60, losses=0.0), "record more takes"),
    ):
        with pytest.raises(ConfigError, match=match):
            fit_calibration(records)
