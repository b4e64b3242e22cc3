"""Trackers of tiny networks, and clips for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from quest.model.config import NetworkConfig
from quest.monitor import SIGNALS, Calibration
from quest.monitor import memory as memories
from quest.monitor.calibrator import Calibrator
from quest.monitor.statistic import Cusum
from quest.track import Tracker, TrackerConfig
from quest.track.settings import REVISION
from quest.types import Clip
from tests.synthetic import make_take
from tests.tiny import DEFAULT, make_network

EAGER = TrackerConfig(slot_threshold=0.0, prompt_threshold=0.0)
"""Discovery takes every peak, which random weights need."""


def make_tracker(network: NetworkConfig = DEFAULT, config: TrackerConfig = EAGER, *, seed: int = 0) -> Tracker:
    """In float32, so that what must be equal is equal to 1e-5."""
    tracker = Tracker(make_network(network, seed=seed), config, device=torch.device("cpu"))
    tracker._autocast = False
    return tracker


def make_clip(*, frames: int = 6, size: tuple[int, int] = (64, 64)) -> Clip:
    """The first view of a synthetic take."""
    return make_take(frames=frames, views=1, entities=2, size=size).views[0].clip


def make_calibration(*, alarming: bool) -> Calibration:
    """A monitor that finds every frame suspicious, or none, whatever the signals."""
    signals, features = len(SIGNALS), memories.FEATURES
    calibrator = Calibrator(
        center=np.zeros(signals),
        scale=np.ones(signals),
        direct=np.zeros((1, features)),
        inner=np.zeros((1, features, 0)),
        inner_bias=np.zeros((1, 0)),
        outer=np.zeros((1, 0)),
        bias=np.array([3.0 if alarming else -3.0]),
    )
    return Calibration(calibrator, Cusum(0.0), np.linspace(0.0, 5.0, 200), 60, "made up", REVISION)


def without_depth(clip: Clip, frames: slice) -> Clip:
    """The same, with no depth in some frames."""
    assert clip.depth_m is not None
    depth_m = clip.depth_m.copy()
    depth_m[frames] = 0
    return replace(clip, depth_m=depth_m)


def moved_world(clip: Clip, world_from_old: np.ndarray) -> Clip:
    """The same frames in another world frame."""
    return replace(clip, cam_from_world=clip.cam_from_world @ np.linalg.inv(world_from_old))
