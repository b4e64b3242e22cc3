"""QueST itself and what is left of it without one of its parts, by the names of the registry."""

from __future__ import annotations

from functools import partial

from quest.baselines import Shared
from quest.baselines.dense_match import DenseMatch, token_features
from quest.baselines.pixels_only import PixelsOnly
from quest.baselines.redetect import Redetect
from quest.track import Tracker


def whole(name: str, shared: Shared) -> Tracker:
    """The tracker itself."""
    return shared.tracker


def pixels_only(name: str, shared: Shared) -> PixelsOnly:
    """The tracker without depth."""
    return PixelsOnly.without_depth(shared.tracker, name=name)


def redetect(name: str, shared: Shared, *, every: int) -> Redetect:
    """The finder without queries, which looks in every ``every``-th frame."""
    return Redetect(shared.tracker, every=every, name=name)


def tokens(name: str, shared: Shared) -> DenseMatch:
    """Every frame matched to the query's by tokens of the vision transformer."""
    features = partial(token_features, shared.tracker.network.encoder)
    return DenseMatch(name, features, weights_hash=shared.tracker.weights_hash)
