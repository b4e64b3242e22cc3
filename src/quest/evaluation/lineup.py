"""Trackers by the names that commands and tables call them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import quest
from quest.baselines import Detector, FlowChain, HoldStill, LucasKanade, Redetect
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.memory import remember_frames
from quest.evaluation.pixels_only import PixelsOnly
from quest.evaluation.protocols import ClipTracker
from quest.model.precision import fast_bfloat16
from quest.track import Tracker
from quest.types import Clip

_REMEMBERED_FRAMES = 1000

FLOW_NOISES: dict[str, float] = {
    "flow-chain": 0.0,
    "flow-chain-0.01": 0.01,
    "flow-chain-0.02": 0.02,
    "flow-chain-0.05": 0.05,
}
"""Standard deviation of the noise on every step of chained flow, normalised units, by the tracker's name."""

REDETECT_EVERY: dict[str, int] = {"redetect": 4, "redetect-1": 1}
"""Frames from one detection to the next, by the tracker's name."""

OF_WEIGHTS = ("quest", "quest-ungrounded", "quest-pixels", *REDETECT_EVERY, *FLOW_NOISES)
"""Trackers that need weights of QueST."""


def line_up(
    names: Sequence[str], *, weights: str, unit_m: Callable[[Clip], float], seed: int = 0
) -> tuple[ClipTracker, ...]:
    """The trackers of some names; all that need weights share one network and what it sees in a frame.

    Args:
        names: of :data:`OF_WEIGHTS`, ``lk`` or ``hold-still``; each counts once.
        weights: name or file of the weights.
        unit_m: metres per normalised unit of a clip, for the noise of chained flow (see :func:`units_of`).
        seed: of that noise.

    Raises:
        ConfigError: no tracker of that name.
        WeightsError: the weights cannot be loaded, or lack what a tracker needs.
    """
    plain: dict[str, Callable[[], ClipTracker]] = {"lk": LucasKanade, "hold-still": HoldStill}
    names = list(dict.fromkeys(names))
    unknown = [name for name in names if name not in (*OF_WEIGHTS, *plain)]
    if unknown:
        raise ConfigError(f"tracker {unknown[0]!r}: expected one of {', '.join((*OF_WEIGHTS, *plain))}")
    tracker = None
    if any(name in OF_WEIGHTS for name in names):
        tracker = quest.load(weights)
        remember_frames(tracker.network, capacity=_REMEMBERED_FRAMES)  # all protocols and settings see the same frames
    found: list[ClipTracker] = []
    for name in names:
        if name in plain:
            found.append(plain[name]())
        else:
            assert tracker is not None
            found.append(tracker if name == "quest" else variant(tracker, name, unit_m=unit_m, seed=seed))
    return tuple(found)


def variant(tracker: Tracker, name: str, *, unit_m: Callable[[Clip], float], seed: int = 0) -> ClipTracker:
    """The tracker of a name of :data:`OF_WEIGHTS` but the first that uses another one's network and settings.

    Raises:
        WeightsError: the network lacks what the tracker needs.
    """
    if name == "quest-ungrounded":
        return tracker.with_config(replace(tracker.config, ground=False), name=name)
    if name == "quest-pixels":
        return PixelsOnly.without_depth(tracker, name=name)
    detector = detector_of(tracker)
    if name in REDETECT_EVERY:
        return Redetect(detector, every=REDETECT_EVERY[name], name=name)
    return FlowChain(detector, unit_m=unit_m, noise=FLOW_NOISES[name], seed=seed, name=name)


def detector_of(tracker: Tracker) -> Detector:
    """What finds the slots that a tracker would discover: the same map, threshold and radius.

    Raises:
        WeightsError: the network has no affordance map.
    """
    config = tracker.config
    odds = math.log(config.slot_threshold / (1 - config.slot_threshold))
    return Detector(
        tracker.network,
        device=tracker.device,
        min_logit=odds / config.slot_gain - config.slot_bias,
        radius_cells=config.slot_radius_cells,
        autocast=fast_bfloat16(tracker.device),
        weights_hash=tracker.weights_hash,
    )


def units_of(stores: Sequence[TakeStore]) -> Callable[[Clip], float]:
    """Metres per normalised unit of the clips of stores, by their names."""
    known: Mapping[str, float] = {
        clip: header.info.half_diagonal_m
        for store in stores
        for header in store.headers().values()
        for clip in header.clip_names
    }

    def unit_m(clip: Clip) -> float:
        if clip.name not in known:
            raise ConfigError(f"clip {clip.name!r}: expected one of the stores at hand, which say how large it is")
        return known[clip.name]

    return unit_m
