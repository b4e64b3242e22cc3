"""How far apart two values may be that should be the same, by what they are.

One row a quantity, so that a tolerance is argued once. What a test claims about quality (a door found within three
degrees) is no tolerance and stays in the test.
"""

from __future__ import annotations

from typing import Any, TypedDict

import pytest


class Tolerance(TypedDict):
    """Keywords of ``torch.testing.assert_close`` and ``numpy.testing.assert_allclose``."""

    rtol: float
    atol: float


EXACT = Tolerance(rtol=0.0, atol=0.0)
"""The same numbers read or computed in the same way."""

DOUBLE = Tolerance(rtol=1e-9, atol=1e-9)
"""Rigid motions and projections in float64, of metres and pixels up to a thousand: a few hundred roundings."""

NETWORK = Tolerance(rtol=1e-4, atol=1e-5)
"""Activations in float32 of the same input in another batch or by a plain loop: sums in another order."""

NETWORK_DEEP = Tolerance(rtol=1e-3, atol=1e-5)
"""Likewise after a whole network, or probabilities that are products of many of its answers."""

LOSS = Tolerance(rtol=1e-4, atol=1e-6)
"""A mean in float32 against a plain loop in float64; the absolute part is for losses that should be zero."""

TRAINED = Tolerance(rtol=1e-3, atol=1e-6)
"""A loss after some steps of which each summed its gradient in another order (processes, micro-batches)."""

PIXEL = Tolerance(rtol=1e-6, atol=1e-4)
"""Pixels of the same frames in another batch or a shorter clip."""

PIXEL_MOVED = Tolerance(rtol=1e-6, atol=1e-3)
"""Pixels that went through other coordinates: lifted and projected in float32, another world, another order."""

POINT = Tolerance(rtol=1e-6, atol=1e-5)
"""World points of the same frames in another batch or a shorter clip, metres."""

POINT_MOVED = Tolerance(rtol=1e-6, atol=1e-3)
"""World points that went through other coordinates, metres."""


def approx(expected: Any, tolerance: Tolerance) -> Any:
    """``pytest.approx`` with a row of the table."""
    return pytest.approx(expected, rel=tolerance["rtol"], abs=tolerance["atol"])
