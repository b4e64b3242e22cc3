"""QueST itself and what is left of it without one of its parts, by the names of the registry."""

from __future__ import annotations

import math

from quest.baselines import Shared
from quest.baselines.flow_chain import FlowChain
from quest.baselines.pixels_only import PixelsOnly
from quest.baselines.redetect import Detector, Redetect
from quest.model.precision import fast_bfloat16
from quest.track import Tracker


def whole(name: str, shared: Shared) -> Tracker:
    """The tracker itself."""
    return shared.tracker


def pixels_only(name: str, shared: Shared) -> PixelsOnly:
    """The tracker without depth."""
    return PixelsOnly.without_depth(shared.tracker, name=name)


def redetect(name: str, shared: Shared, *, every: int) -> Redetect:
    """The network without queries, which detects in every ``every``-th frame."""
    return Redetect(detector_of(shared.tracker), every=every, name=name)


def flow_chain(name: str, shared: Shared, *, noise: float) -> FlowChain:
    """The network's flow, chained with noise of that standard deviation, normalised units."""
    detector = detector_of(shared.tracker)
    return FlowChain(detector, unit_m=shared.unit_m, noise=noise, seed=shared.seed, name=name)


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
