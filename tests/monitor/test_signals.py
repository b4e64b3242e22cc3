"""Signals of a frame."""

from __future__ import annotations

import numpy as np
import pytest

from quest.errors import InputError
from quest.monitor import SIGNALS, Signals


def test_signals_by_name():
    values = np.arange(2 * len(SIGNALS), dtype=np.float32).reshape(2, -1)
    signals = Signals(values)
    assert len(signals) == 2
    assert signals.named(1) == dict(zip(SIGNALS, values[1].tolist(), strict=True))
    assert signals.named(0)["anchor_cosine"] == 0.0


@pytest.mark.parametrize("shape", [(2, len(SIGNALS) + 1), (len(SIGNALS),)])
def test_another_number_of_signals(shape: tuple[int, ...]):
    with pytest.raises(InputError):
        Signals(np.zeros(shape, np.float32))
