"""Trackers of tiny networks, and clips for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from quest.model.finder import FinderConfig
from quest.monitor import Calibration
from quest.monitor.statistic import Cusum
from quest.track import Tracker, TrackerConfig
from quest.track.settings import REVISION
from quest.types import Clip
from tests.synthetic import make_take
from tests.tiny import FINDER, make_finder

EAGER = TrackerConfig(threshold=0.0, prompt_threshold=0.0, size_px=64)
"""Discovery takes whatever is found, which random weights need."""


def make_tracker(network: FinderConfig = FINDER, config: TrackerConfig = EAGER, *, seed: int = 0) -> Tracker:
    """A tracker without a monitor, whose network finds anything."""
    return Tracker(make_finder(network, seed=seed), config, device=torch.device("cpu"))


def make_clip(*, frames: int = 6, size: tuple[int, int] = (64, 64)) -> Clip:
    """The first view of a synthetic take."""
    return make_take(frames=frames, views=1, entities=2, size=size).views[0].clip


def make_calibration(*, alarming: bool) -> Calibration:
    """A monitor that finds every frame suspicious, or none, whatever the filter says."""
    return Calibration(
        slope=1e-6,
        shift=3.0 if alarming else -3.0,
        statistic=Cusum(0.0),
        maxima=np.linspace(0.0, 5.0, 200),
        block_frames=60,
        about="made up",
        revision=REVISION,
    )


def without_depth(clip: Clip, frames: slice) -> Clip:
    """The same, with no depth in some frames."""
    assert clip.depth_m is not None
    depth_m = clip.depth_m.copy()
    depth_m[frames] = 0
    return replace(clip, depth_m=depth_m)


def moved_world(clip: Clip, world_from_old: np.ndarray) -> Clip:
    """The same frames in another world frame."""
    return replace(clip, cam_from_world=clip.cam_from_world @ np.linalg.inv(world_from_old))
