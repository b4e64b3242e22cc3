import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quest.geometry.vectors import cross, rotated


@pytest.mark.parametrize(("one", "other"), [((3,), (3,)), ((3,), (7, 3)), ((4, 7, 3), (3,)), ((4, 7, 3), (7, 3))])
def test_cross_products_are_those_of_numpy_to_the_last_bit(one: tuple[int, ...], other: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=one), rng.normal(size=other)
    assert np.array_equal(cross(a, b), np.cross(a, b))


def test_vectors_turn_as_rotations_do():
    rng = np.random.default_rng(0)
    for _ in range(20):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        vector, angle = rng.normal(size=3), float(rng.uniform(-4, 4))
        expected = Rotation.from_rotvec(angle * axis).apply(vector)
        np.testing.assert_allclose(rotated(vector, axis, angle), expected, atol=1e-12)
