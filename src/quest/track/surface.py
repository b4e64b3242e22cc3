"""Which way the surface around a place faces: what a link's front tells of its motion, where a handle tells little."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from jaxtyping import Float

from quest.geometry.vectors import cross
from quest.grounding.hinge import Plane
from quest.model.observation import FrameBatch
from quest.track.following import Following, as_rows

_RADIUS = 0.15
_WINDOW_PX = 24
_TOLERANCE = 0.012
_LEAST_POINTS = 30
_MOST_POINTS = 225
_LEAST_SHARE = 0.3
_PLANES = 96


def face(frames: FrameBatch, following: Sequence[Following], *, elapsed: float) -> None:
    """Tell every query how the front of its link stands in a frame, before anything else is known of the frame.

    Args:
        frames: the newest frame (B = T = 1).
        following: the queries.
        elapsed: frames since the one before.
    """
    image = frames.image_points()[0, 0].permute(1, 2, 0).cpu().numpy()
    places = torch.from_numpy(as_rows(query.place for query in following)).to(frames.depth_m)
    uv_px = frames.from_reference(places[None, None])[0, 0].cpu().numpy()
    camera = ((frames.ref_from_cam[0, 0, :3, 3] - frames.center[0]) / frames.scale[0]).cpu().double().numpy()
    for query, uv in zip(following, uv_px, strict=True):
        plane = None
        if query.place is not None and not query.buried and not query.doubted:
            near, least = query.ground.front.expected(query.place)
            plane = plane_at(image, uv, query.place, camera, near=near, least_cosine=least)
        query.ground.face(plane, elapsed=elapsed)


def plane_at(
    image: Float[np.ndarray, "H W 3"],
    uv_px: Float[np.ndarray, "2"],
    place: Float[np.ndarray, "3"],
    camera: Float[np.ndarray, "3"],
    *,
    near: Float[np.ndarray, "3"] | None,
    least_cosine: float,
) -> Plane | None:
    """The plane that most of what is seen around a place lies in.

    Args:
        image: what every pixel shows, reference frame; 0 where it is not known.
        uv_px: where the place is in it.
        place: the place.
        camera: where the camera is.
        near: the normal that is expected; None where none is.
        least_cosine: least cosine between them.

    Returns:
        None where too little lies in a plane that is turned so.
    """
    h, w = image.shape[:2]
    if not (np.isfinite(uv_px).all() and 0 <= uv_px[0] < w and 0 <= uv_px[1] < h):
        return None
    x, y = int(uv_px[0]), int(uv_px[1])
    around = image[max(0, y - _WINDOW_PX) : y + _WINDOW_PX + 1, max(0, x - _WINDOW_PX) : x + _WINDOW_PX + 1]
    around = around.reshape(-1, 3).astype(np.float64)
    gap = np.square(around - place).sum(axis=1)
    points = around[(gap < _RADIUS**2) & (around != 0).any(axis=1)]
    if len(points) < _LEAST_POINTS:
        return None
    if len(points) > _MOST_POINTS:
        points = points[np.linspace(0, len(points) - 1, _MOST_POINTS).astype(int)]
    a, b, c = points[(_picks() * len(points)).astype(int)].swapaxes(0, 1)
    normal = cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    keep = length > 1e-5
    normal, a = normal[keep] / length[keep, None], a[keep]
    if near is not None:
        keep = np.abs(normal @ near) >= least_cosine
        normal, a = normal[keep], a[keep]
    if not len(normal):
        return None
    off = np.abs(normal @ points.T - (normal * a).sum(axis=1, keepdims=True))
    on = off < _TOLERANCE
    best = int(on.sum(axis=1).argmax())
    inside = points[on[best]]
    if len(inside) < max(_LEAST_SHARE * len(points), _LEAST_POINTS / 2):
        return None
    middle = inside.mean(axis=0)
    found = np.linalg.svd(inside - middle, full_matrices=False)[2][2]
    towards = camera - middle if near is None else near
    found = found if found @ towards >= 0 else -found
    if near is not None and found @ near < least_cosine:
        return None
    return Plane(found, middle, bool(found @ (camera - middle) < 0))


@cache
def _picks() -> Float[np.ndarray, "N 3"]:
    """Which of the points around a place the tried planes go through, as shares of their number."""
    return np.random.default_rng(0).random((_PLANES, 3))
