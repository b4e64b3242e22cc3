"""What a frame says of places: before a wall, in it, behind it, outside the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from quest.model.observation import cell_centres
from quest.track.evidence import FrameEvidence
from tests.tiny import DEFAULT, make_frames

WALL_M = 1.5


def evidence(log_p: torch.Tensor | None = None, *, padding_px: int = 0) -> tuple[FrameEvidence, float]:
    """One frame that looks at a wall, padded left and right, and the metres of a reference unit."""
    frames = make_frames(batch=1, frames=1)
    frames = replace(frames, depth_m=torch.full_like(frames.depth_m, WALL_M))
    log_p = torch.zeros(DEFAULT.cells**2) if log_p is None else log_p
    size = DEFAULT.encoder.image_size
    return FrameEvidence(frames, log_p, DEFAULT, (padding_px, 0, size - padding_px, size)), float(frames.scale[0])


def place(depth_m: float, *, x_px: float = 32.0) -> np.ndarray:
    """A point under a pixel of the middle row, in the reference frame."""
    frames = make_frames(batch=1, frames=1)
    size = DEFAULT.encoder.image_size
    uv_px = torch.tensor([[[[x_px, size / 2]]]])
    return frames.to_reference(uv_px, torch.tensor([[[depth_m]]]))[0, 0, 0].double().numpy()


@pytest.mark.parametrize(("depth_m", "room_m"), [(1.2, 0.3), (1.5, 0.0), (1.9, -0.4)])
def test_room_is_what_is_seen_behind_a_place(depth_m: float, room_m: float):
    frame, scale = evidence()
    assert frame.room(place(depth_m)[None])[0] == pytest.approx(room_m / scale, abs=1e-4)


def test_nothing_is_known_where_nothing_is_seen():
    frame, _ = evidence()
    outside = place(1.5, x_px=-20.0)[None]
    assert np.isnan(frame.room(outside)).all()
    assert np.isnan(frame.ratio(outside)).all()


def test_padding_says_nothing():
    at = np.stack([place(1.5, x_px=x_px) for x_px in (7.0, 9.0)])
    assert np.isnan(evidence(padding_px=8)[0].ratio(at)).tolist() == [True, False]
    assert np.isfinite(evidence()[0].ratio(at)).all()


def test_ratio_is_that_of_the_cell_to_chance():
    log_p = torch.randn(DEFAULT.cells**2, generator=torch.Generator().manual_seed(0))
    frame, _ = evidence(log_p)
    cell = 35
    x, y = cell_centres(DEFAULT)[cell].tolist()
    frames = make_frames(batch=1, frames=1)
    point = frames.to_reference(torch.tensor([[[[x, y]]]]), torch.tensor([[[WALL_M]]]))[0, 0].double().numpy()
    chance = -np.log(DEFAULT.cells**2)
    assert frame.ratio(point)[0] == pytest.approx(float(log_p[cell]) - chance, abs=1e-3)
