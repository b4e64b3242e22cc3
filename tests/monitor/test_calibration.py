"""Calibrated log odds, and the text and file that keep a calibration."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from quest.errors import WeightsError
from quest.monitor import Budget, Calibration, calibration, probability, read_calibrations, write_calibrations
from quest.monitor.calibration import LOGIT_LIMIT
from quest.monitor.statistic import Cusum
from tests.monitor.calibrations import share

MAXIMA = np.sort(np.random.default_rng(0).random(20))


def made() -> Calibration:
    return Calibration(0.8, -0.5, Cusum(-1.0, 0.85), MAXIMA, 60, "a test", 0)


@pytest.mark.parametrize(
    ("streams", "never"), [(19, "at all"), (24, "after 60 frames"), (45, "after 60 frames"), (46, None)]
)
def test_alarms_that_cannot_come_are_told(streams: int, never: str | None):
    few = replace(made(), maxima=np.sort(np.random.default_rng(0).random(streams)))
    told = few.shortfall(Budget(0.05))
    assert (told is None) == (never is None)
    assert never is None or (told is not None and never in told)
    assert few.shortfall(Budget(0.05, 60)) is None or streams < 20
    assert (few.least_alpha <= 0.05) == (streams >= 24)


def test_a_watch_may_be_too_short_for_an_alarm():
    """Eight frames add up to 8 x 11 at most."""
    high = replace(made(), statistic=Cusum(-3.0, 1.0), maxima=np.linspace(80.0, 100.0, 60))
    assert high.shortfall(Budget(0.5)) is None
    for budget, frames in ((Budget(0.5, 8), None), (Budget(0.5), 8)):
        told = high.shortfall(budget, frames=frames)
        assert told is not None
        assert "at all" in told
    assert high.shortfall(Budget(0.5, 9)) is None


def test_later_blocks_have_thresholds_that_nothing_exceeds():
    """A frame adds at most 8 + 3 to a sum that forgets everything, and these maxima have a long tail."""
    tailed = replace(made(), statistic=Cusum(-3.0, 0.0), maxima=np.sort(np.random.default_rng(0).exponential(2, 200)))
    told = tailed.shortfall(Budget(0.05))
    assert told is not None
    block = int(told.split("after ")[1].split()[0]) // 60
    assert 1 <= block < 1000
    last, next_one = (tailed.threshold(share(0.05, block=b, restart=0)).value for b in (block, block + 1))
    assert last < 11.0 <= next_one
    assert replace(tailed, statistic=Cusum(-3.0, 1.0)).shortfall(Budget(0.05)) is None
    assert tailed.shortfall(Budget(0.05, 60)) is None
    assert tailed.shortfall(Budget(0.05), frames=60 * block) is None
    assert tailed.shortfall(Budget(0.05), frames=60 * block + 1) == told
    # What forgets nothing starts anew in each block all the same: five frames add up to 55.
    short = replace(tailed, statistic=Cusum(-3.0, 1.0), maxima=5 * tailed.maxima, block_frames=5)
    told = short.shortfall(Budget(0.05))
    assert told is not None
    block = int(told.split("after ")[1].split()[0]) // 5
    last, next_one = (short.threshold(share(0.05, block=b, restart=0)).value for b in (block, block + 1))
    assert last < 55.0 <= next_one


def test_log_odds_are_scaled_shifted_and_bounded():
    log_odds = np.array([[0.0, 2.0, np.nan], [-9.0, 9.0, 1000.0]], np.float32)
    expected = [[-0.5, 1.1, np.nan], [-7.7, 6.7, LOGIT_LIMIT]]
    np.testing.assert_allclose(made().logit(log_odds), expected, rtol=1e-6)
    np.testing.assert_allclose(probability(np.array([0.0, np.log(3.0), np.nan])), [0.5, 0.75, np.nan])


def test_round_trip():
    text = made().to_json()
    again = Calibration.from_json(text)
    assert "\n" not in text
    assert again.to_json() == text
    assert replace(again, maxima=MAXIMA) == replace(made(), maxima=MAXIMA)
    assert (again.maxima >= MAXIMA).all()  # rounded up: a threshold never becomes more eager
    np.testing.assert_allclose(again.maxima, MAXIMA, atol=2e-4)


def damaged(**changes: object) -> str:
    return json.dumps({**json.loads(made().to_json()), **changes})


DAMAGED = (
    "{", "[]", "{}", damaged(format=0), damaged(maxima=[]), damaged(maxima=[2.0, 1.0]), damaged(maxima="none"),
    damaged(block_frames=0), damaged(statistic={"drift": 0.0, "keep": 2.0}), damaged(statistic={"other": 0.0}),
    damaged(slope=0.0), damaged(slope=None), damaged(shift="inf"), damaged(unit="house"),
)  # fmt: skip


def test_a_text_that_is_no_calibration():
    for text in DAMAGED:
        with pytest.raises(WeightsError, match=r"calibrate"):
            Calibration.from_json(text)
    with pytest.raises(WeightsError, match="ascending"):
        replace(made(), maxima=MAXIMA[::-1])


def test_the_file_keeps_both(tmp_path: Path):
    path = tmp_path / "new" / "monitor.json"
    both = {"depth": made(), "colours": replace(made(), slope=0.3)}
    write_calibrations(path, both)  # type: ignore[arg-type]
    again = read_calibrations(path)
    assert {inputs: (c.slope, c.to_json()) for inputs, c in again.items()} == {
        inputs: (c.slope, c.to_json()) for inputs, c in both.items()
    }
    write_calibrations(path, {"colours": made()})
    assert list(read_calibrations(path)) == ["colours"]


def test_the_file_that_ships(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(calibration, "resources", SimpleNamespace(files=lambda package: tmp_path))
    assert read_calibrations() == {}
    write_calibrations(tmp_path / "assets" / "monitor.json", {"depth": made()})
    assert list(read_calibrations()) == ["depth"]


def test_a_file_that_is_damaged_or_not_there(tmp_path: Path):
    path = tmp_path / "monitor.json"
    for text in ("", "{", "[]", "{}", '{"sound": {}}', '{"depth": {}}', '{"depth": 3}', "\ud800", None):
        path.unlink() if text is None else path.write_bytes(text.encode("utf-8", "surrogatepass"))
        with pytest.raises(WeightsError, match=r"monitor\.json.*quest calibrate") as error:
            read_calibrations(path)
        assert "\n" not in str(error.value)
