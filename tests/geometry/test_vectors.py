import numpy as np
import pytest

from quest.geometry.vectors import cross


@pytest.mark.parametrize(("one", "other"), [((3,), (3,)), ((3,), (7, 3)), ((4, 7, 3), (3,)), ((4, 7, 3), (7, 3))])
def test_cross_products_are_those_of_numpy_to_the_last_bit(one: tuple[int, ...], other: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=one), rng.normal(size=other)
    assert np.array_equal(cross(a, b), np.cross(a, b))
