"""Textured planes in front of a camera, rendered by shifting pictures."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from quest.filter.picture import Picture
from quest.types import Camera, Clip, Query, Tracks
from tests.track.clips import make_tracker

SIZE = (160, 120)
FOCAL = 150.0
WALL_M = 2.0


def follow(clip: Clip, queries: list[Query]) -> Tracks:
    """What the tracker answers, without a monitor."""
    return make_tracker().track(clip, queries)


def texture(width: int, height: int, seed: int) -> np.ndarray:
    """Grey values that Lucas-Kanade can hold on to."""
    noise = np.random.default_rng(seed).random((height, width)).astype(np.float32)
    fine, coarse = cv2.GaussianBlur(noise, (0, 0), 1.5), cv2.GaussianBlur(noise, (0, 0), 5)
    both = fine / fine.std() + coarse / coarse.std()
    return cv2.normalize(both, None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]


def shifted(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """The part of a larger picture that is seen from (x, y) on."""
    move = np.array([[1, 0, -x], [0, 1, -y]], np.float32)
    return cv2.warpAffine(image, move, SIZE)  # type: ignore[call-overload]


def plain(grey: np.ndarray) -> Picture:
    """A picture without descriptors."""
    return Picture(grey, np.ones((1, 1, 1), np.float32))


@dataclass(frozen=True)
class Board:
    """A textured board in front of the wall, where its left upper corner is in each frame, and how near it is."""

    corner_px: np.ndarray
    """[T, 2], whole pixels; what is outside the picture is cut off."""
    size: tuple[int, int]
    depth_m: float
    seed: int


def scene(camera_m: np.ndarray, *boards: Board, depth: bool = True) -> Clip:
    """Frames of a wall, boards in front of it, and a camera that slides sideways.

    Args:
        camera_m: [T], metres to the right.
        boards: the later ones are in front.
        depth: whether there is any.
    """
    wall = texture(3 * SIZE[0], SIZE[1], seed=0)
    rgb, depths = [], []
    for t, x_m in enumerate(camera_m):
        grey = shifted(wall, SIZE[0] + FOCAL * x_m / WALL_M, 0)
        depth_m = np.full(grey.shape, WALL_M, np.float32)
        for board in boards:
            (x, y), (width, height) = board.corner_px[t].astype(int), board.size
            rows = slice(max(y, 0), max(min(y + height, SIZE[1]), 0))
            columns = slice(max(x, 0), max(min(x + width, SIZE[0]), 0))
            shown = texture(width, height, board.seed)[rows.start - y : rows.stop - y]
            grey[rows, columns] = shown[:, columns.start - x : max(columns.stop, columns.start) - x]
            depth_m[rows, columns] = board.depth_m
        rgb.append(np.repeat(grey[..., None], 3, axis=-1))
        depths.append(depth_m)
    poses = np.tile(np.eye(4), (len(camera_m), 1, 1))
    poses[:, 0, 3] = -np.asarray(camera_m)
    camera = Camera(FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, *SIZE)
    stamps = np.arange(len(camera_m)) / 15
    return Clip("scene", camera, np.stack(rgb), np.stack(depths) if depth else None, stamps, poses)
