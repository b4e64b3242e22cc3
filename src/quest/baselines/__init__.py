"""Trackers to compare: each is one line in :data:`TRACKERS`, from which commands take names, help and errors.

The plain ones follow pixels and need no weights; the others are QueST without one of its parts. Nothing
heavy is imported before a tracker is built.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

from quest.errors import ConfigError, WeightsError
from quest.types import Clip, Query, Tracks

if TYPE_CHECKING:
    from quest.track import Tracker

Inputs = Literal["depth and poses", "depth", "colours"]
"""What of a real recording a tracker is shown."""

EVERYTHING: tuple[Inputs, ...] = ("depth and poses", "depth", "colours")


@runtime_checkable
class ClipTracker(Protocol):
    """Anything that tracks: QueST and the baselines."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """Answer the queries; without any, discover entities."""
        ...


@dataclass(frozen=True)
class Shared:
    """What trackers that are made of the same weights share."""

    tracker: Tracker
    """The tracker whose networks and settings they use."""


@dataclass(frozen=True)
class Entry:
    """How a tracker is made, and what is said of it."""

    about: str
    """What it does, in a few words."""
    maker: str
    """``module:function`` in this package. It is called with the settings; before them, for trackers of weights,
    with the name and a :class:`Shared`."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Keyword arguments of the maker."""
    of_weights: bool = False
    """Whether it needs weights of QueST."""
    inputs: tuple[Inputs, ...] = ("colours",)
    """What it is shown of real recordings, one row of the table each; what a recording lacks is left out."""

    def build(self, name: str, shared: Shared | None = None) -> ClipTracker:
        """The tracker.

        Raises:
            WeightsError: the network lacks what the tracker needs.
        """
        module, _, function = self.maker.partition(":")
        make = getattr(import_module(f"quest.baselines.{module}"), function)
        return make(name, shared, **self.settings) if self.of_weights else make(**self.settings)


def _of_weights(about: str, maker: str, *, inputs: tuple[Inputs, ...] = EVERYTHING, **settings: Any) -> Entry:
    return Entry(about, f"of_weights:{maker}", settings, of_weights=True, inputs=inputs)


TRACKERS: dict[str, Entry] = {
    "quest": _of_weights("this tracker", "whole"),
    "quest-pixels": _of_weights("quest without depth", "pixels_only", inputs=("colours",)),
    "redetect": _of_weights("its finder without queries, every 4th frame", "redetect", every=4),
    "redetect-1": _of_weights("the same in every frame", "redetect", every=1),
    "hold-still": Entry("the first position for ever", "hold_still:HoldStill"),
    "lk": Entry("Lucas-Kanade, one point", "lucas_kanade:LucasKanade"),
    "lk-grid": Entry("Lucas-Kanade, 5 x 5 points checked backwards", "lucas_kanade:LucasKanadeGrid"),
    "dis": Entry("dense optical flow, chained", "dense_flow:DenseFlow"),
    "xfeat": Entry("every frame matched to the query's by dense features", "dense_match:DenseMatch"),
    "world-pnp": Entry("still in the world, camera by LK and PnP", "still_world:StillWorld", inputs=("depth",)),
    "world-given": Entry(
        "still in the world, given poses", "hold_still:HoldStill", {"name": "world-given"}, inputs=("depth and poses",)
    ),
}
"""Every tracker by the name that commands and tables call it."""


def line_up(names: Sequence[str], *, weights: str) -> tuple[ClipTracker, ...]:
    """The trackers of some names; all that need weights share one network.

    Args:
        names: of :data:`TRACKERS`; each counts once.
        weights: name or file of the weights.

    Raises:
        ConfigError: no tracker of that name.
        WeightsError: the weights cannot be loaded, or lack what a tracker needs.
    """
    unknown = [name for name in names if name not in TRACKERS]
    if unknown:
        raise ConfigError(f"tracker {unknown[0]!r}: expected one of {', '.join(TRACKERS)}")
    shared = None
    if any(TRACKERS[name].of_weights for name in names):
        import quest
        from quest.track import Tracker

        shared = Shared(quest.load(weights))
        other = [name for name in names if TRACKERS[name].of_weights and name != "quest"]
        if other and not isinstance(shared.tracker, Tracker):
            raise WeightsError(f"tracker {other[0]!r}: these weights are of the published network; use a finder's")
    return tuple(TRACKERS[name].build(name, shared) for name in dict.fromkeys(names))
