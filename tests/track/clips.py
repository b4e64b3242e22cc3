"""Trackers of tiny networks, and clips for them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import torch

from quest.model.finder import OPENINGS
from quest.model.found import LABELS_FOUND, Found, Panels
from quest.model.xfeat import XFeat
from quest.monitor import Calibration
from quest.monitor.statistic import Cusum
from quest.track import Stream, StreamState, Tracker, TrackerConfig
from quest.track.settings import REVISION
from quest.types import Clip, Query
from tests.synthetic import make_take
from tests.tiny import make_finder

EAGER = TrackerConfig(threshold=0.0, prompt_threshold=0.0, size_px=64, follow_px=64)
"""Discovery takes whatever is found, which random weights need."""


POINTS = (Query.point(0, 20, 30, name="a"), Query.point(0, 40.5, 22.25, name="b", label="knob"))
"""Of :func:`make_clip`."""

finder, features = cache(make_finder), cache(XFeat.from_package)


def make_tracker(config: TrackerConfig = EAGER, *, seed: int = 0, **calibrations: Calibration) -> Tracker:
    """A tracker whose network finds anything; without calibrations nothing is watched."""
    tracker = Tracker(finder(seed=seed), config, device=torch.device("cpu"), features=features())
    tracker.calibrations = dict(calibrations)  # type: ignore[assignment]
    return tracker


def feed(stream: Stream, clip: Clip, frames: range, **changes: object) -> list[StreamState]:
    """Answers to some frames of a clip."""
    return [stream.step(**{**vars(clip.frame(t)), **changes}) for t in frames]  # type: ignore[arg-type]


def make_found(*places: tuple[str, str, tuple[float, float]], p: tuple[float, ...] | None = None) -> Found:
    """What a finder says, the surest first: label, intent and pixel of each; it is sure where no probabilities are."""
    n = len(places)
    odds = np.exp(9.0 - np.arange(n)) if p is None else np.array(p) / (1 - np.array(p))
    return Found(
        uv_px=np.array([at for *_, at in places], np.float64).reshape(-1, 2),
        logit=np.log(odds),
        label_p=np.eye(len(LABELS_FOUND))[[LABELS_FOUND.index(label) for label, *_ in places]],
        lift_p=np.array([float(intent == "lift") for _, intent, _ in places]),
        box_px=np.full((n, 4), np.nan),
        panel=np.full(n, -1),
        panels=Panels(np.zeros((0, 4)), np.zeros(0, np.int64), np.zeros(0), np.zeros((0, len(OPENINGS)))),
    )


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
