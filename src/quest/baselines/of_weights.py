"""QueST itself and what is left of it without one of its parts, by the names of the registry."""

from __future__ import annotations

from quest.baselines import Shared
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
