"""The calibrator and the text that keeps it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from quest.errors import WeightsError
from quest.monitor import SIGNALS, Budget, Calibration
from quest.monitor import memory as memories
from quest.monitor.calibration import rounded
from quest.monitor.calibrator import LOGIT_LIMIT, probability
from quest.monitor.statistic import Cusum
from tests.monitor.calibrations import make_calibrator, share

MAXIMA = np.sort(np.random.default_rng(0).random(20))


def made(hidden: int = 3) -> Calibration:
    return Calibration(make_calibrator(hidden=hidden), Cusum(-1.0, 0.85), MAXIMA, 60, "a test", 0)


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


def test_squashing_and_back():
    calibrator = make_calibrator()
    values = 10 * np.random.default_rng(1).normal(size=(3, len(SIGNALS)))
    squashed = calibrator.squash(values)
    np.testing.assert_allclose(calibrator.unsquash(squashed[0]), values[0])
    assert np.isnan(calibrator.squash(np.where(values > 0, np.inf, np.nan))).all()


@pytest.mark.parametrize("hidden", [0, 3])
def test_logit_against_a_plain_loop(hidden: int):
    calibrator = make_calibrator(hidden=hidden)
    x = np.random.default_rng(2).normal(size=(5, memories.FEATURES))
    found = calibrator.logit(x)
    for n in range(5):
        members = []
        for m in range(2):
            units = [
                np.tanh(x[n] @ calibrator.inner[m, :, h] + calibrator.inner_bias[m, h]) * calibrator.outer[m, h]
                for h in range(hidden)
            ]
            members.append(x[n] @ calibrator.direct[m] + sum(units) + calibrator.bias[m])
        assert found[n] == pytest.approx(np.clip(np.mean(members), -LOGIT_LIMIT, LOGIT_LIMIT))
    np.testing.assert_allclose(probability(np.array([0.0, np.log(3.0)])), [0.5, 0.75])


def test_shares_are_what_a_signal_adds():
    calibrator = make_calibrator(hidden=0, members=1)
    rng = np.random.default_rng(3)
    memory = memories.start(1)
    for _ in range(9):
        memory, found = calibrator.step(memory, rng.normal(size=(1, len(SIGNALS))))
    shares = calibrator.shares(found[0], memory[0])
    normal = memories.with_normal(found[0], memory[0])
    np.testing.assert_allclose(shares, (found[0] - normal) @ calibrator.direct[0])


@pytest.mark.parametrize("hidden", [0, 3])
def test_round_trip(hidden: int):
    calibration = made(hidden)
    text = calibration.to_json()
    again = Calibration.from_json(text)
    assert "\n" not in text
    assert again.to_json() == text
    assert (again.statistic, again.block_frames, again.about) == (Cusum(-1.0, 0.85), 60, "a test")
    near = rounded(calibration.calibrator)
    for name, value in vars(again.calibrator).items():
        np.testing.assert_array_equal(value, getattr(near, name))
        np.testing.assert_allclose(value, getattr(calibration.calibrator, name), rtol=1e-3)
    assert (again.maxima >= calibration.maxima).all()  # rounded up: a threshold never becomes more eager
    np.testing.assert_allclose(again.maxima, calibration.maxima, atol=2e-4)


def damaged(**changes: object) -> str:
    return json.dumps({**json.loads(made().to_json()), **changes})


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        "{}",
        damaged(format=0),
        damaged(signals=["other"]),
        damaged(features=3),
        damaged(maxima=[]),
        damaged(maxima=[2.0, 1.0]),
        damaged(maxima="none"),
        damaged(block_frames=0),
        damaged(statistic={"drift": 0.0, "keep": 2.0}),
        damaged(statistic={"other": 0.0}),
        damaged(calibrator={"center": [0.0]}),
        damaged(calibrator=json.loads(made().to_json())["calibrator"] | {"scale": [0.0] * len(SIGNALS)}),
        damaged(calibrator=json.loads(made().to_json())["calibrator"] | {"bias": [0.0]}),
    ],
)
def test_a_text_of_another_version(text: str):
    with pytest.raises(WeightsError, match=r"calibrate"):
        Calibration.from_json(text)


def test_maxima_must_be_sorted():
    with pytest.raises(WeightsError, match="ascending"):
        replace(made(), maxima=MAXIMA[::-1])
