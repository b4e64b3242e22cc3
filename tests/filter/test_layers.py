"""Layers of pictures without depth: what rests and what moves, each carried by a plane of its own."""

from __future__ import annotations

import itertools
from functools import reduce

import cv2
import numpy as np

from quest.filter.layers import Layers, observe_layers, sow_layers
from quest.filter.noise import Noise
from quest.filter.picture import GreyPicture
from quest.types import Clip
from tests.filter.scenes import FOCAL, WALL_M, Board, scene

FRAMES, LARGER = 24, 3.0
LARGE = (480, 360)
STILL = np.zeros(FRAMES)


def pictures(clip: Clip) -> list[GreyPicture]:
    """As large as the tracker follows them."""
    grey = (cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in clip.rgb)
    return [GreyPicture(cv2.resize(each, LARGE), scale=(LARGER, LARGER)) for each in grey]


def observed(clip: Clip) -> list[Layers]:
    """What is known after each frame."""
    nowhere, noise = np.zeros((0, 2)), Noise()
    seen = pictures(clip)
    states = [sow_layers(Layers.none(LARGE), seen[0], nowhere)]
    for before, now in itertools.pairwise(seen):
        states.append(sow_layers(observe_layers(states[-1], before, now, 1 / 15, noise), now, nowhere))
    return states


def sliding(step_px: float, *, size: tuple[int, int], first: float = 20.0) -> Board:
    way = np.stack([first + step_px * np.arange(FRAMES), np.full(FRAMES, 20.0)], axis=-1)
    return Board(way, size, 1.7, seed=5)


def test_the_world_rests_while_something_passes() -> None:
    states = observed(scene(STILL, sliding(3.0, size=(70, 80)), depth=False))
    corner = np.array([[24.0, 24.0]])
    at = states[-1].brought(np.repeat(states[0].onto(corner)[:, :1], len(states[-1]), axis=1))
    np.testing.assert_allclose(at[0, 0], corner[0], atol=0.5)
    warp = reduce(lambda since, pair: pair[1].world_since(pair[0]) @ since, itertools.pairwise(states), np.eye(3))
    np.testing.assert_allclose(cv2.perspectiveTransform(corner[None], warp)[0], corner, atol=0.5)


def test_what_moves_is_a_layer_that_carries_its_points() -> None:
    board = sliding(2.0, size=(60, 50))
    states = observed(scene(STILL, board, depth=False))
    middle = LARGER * (board.corner_px[8:9] + np.array([30.0, 25.0]))
    own = states[8].share(middle).argmax()
    assert own > 0
    there = states[-1].brought(np.repeat(states[8].onto(middle)[:, [own]], len(states[-1]), axis=1))
    np.testing.assert_allclose(there[0, own], middle[0] + LARGER * np.array([2.0 * (FRAMES - 9), 0]), atol=1.5)
    assert states[-1].share(np.array([[460.0, 340.0]])).argmax() == 0


def test_a_moving_camera_moves_the_world_along() -> None:
    camera_m = np.linspace(0, 0.4, FRAMES)
    states = observed(scene(camera_m, depth=False))
    start = LARGER * np.array([[90.0, 60.0]])
    at = states[-1].brought(np.repeat(states[0].onto(start)[:, :1], len(states[-1]), axis=1))
    np.testing.assert_allclose(at[0, 0], start[0] - LARGER * np.array([FOCAL * 0.4 / WALL_M, 0]), atol=0.5)


def test_a_map_that_shrinks_a_layer_to_nothing_is_none() -> None:
    layers = Layers.none(LARGE)
    for bad in (np.zeros((3, 3)), np.diag([1e-3, 1e-3, 1.0]), np.diag([-1.0, 1.0, 1.0]), np.full((3, 3), np.nan)):
        assert layers._with(0, bad, np.eye(8)) is layers


def test_pictures_without_corners_have_layers_without_points() -> None:
    grey, noise, nowhere = GreyPicture(np.full(LARGE[::-1], 90, np.uint8)), Noise(), np.zeros((0, 2))
    layers = sow_layers(Layers.none(LARGE), grey, nowhere)
    for _ in range(3):
        layers = sow_layers(observe_layers(layers, grey, grey, 1 / 15, noise), grey, nowhere)
    at = np.array([[100.0, 50.0]])
    np.testing.assert_allclose(layers.brought(layers.onto(at))[0, 0], at[0], atol=1e-6)
