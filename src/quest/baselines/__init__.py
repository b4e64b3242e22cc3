"""Trackers to compare: each is one line in :data:`TRACKERS`, from which commands take names, help and errors.

The plain ones follow pixels and need no weights; others are QueST without one of its parts, run their authors' code and
weights, where the user has them, or are networks of the same kind that our takes taught (:mod:`.retrained`). Nothing
heavy is imported before a tracker is built.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from quest.errors import ConfigError, WeightsError
from quest.types import Clip, Query, Tracks

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
class Entry:
    """How a tracker is made, and what is said of it."""

    about: str
    """What it does, in a few words."""
    maker: str
    """``module:function`` in this package. It is called with the settings; before them with the name and, for trackers
    of weights, QueST's own, for official and retrained ones, the folder of code and weights. Empty for QueST itself."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Keyword arguments of the maker."""
    of_weights: bool = False
    """Whether it needs weights of QueST."""
    official: bool = False
    """Whether it is its authors' own code and checkpoint, which the user has to have; its name ends so."""
    retrained: bool = False
    """Whether it is a network of a rival's kind that our takes taught, whose weights the user has trained; its name
    ends so."""
    inputs: tuple[Inputs, ...] = ("colours",)
    """What it is shown of real recordings, one row of the table each; what a recording lacks is left out."""

    @property
    def plain(self) -> bool:
        """Whether it needs nothing."""
        return not (self.of_weights or self.official or self.retrained)

    def build(self, name: str, tracker: ClipTracker | None = None, *, rivals: Path | None = None) -> ClipTracker:
        """The tracker.

        Raises:
            ConfigError: official code is not there, or lacks what it needs.
            WeightsError: the network lacks what the tracker needs, or other weights are not there or do not fit.
        """
        if self.retrained and rivals is None:
            raise ConfigError(
                f"tracker {name!r}: it needs weights that `quest bench comparison` trains; put them into a folder as "
                f"{name}.safetensors, and name that with --rivals"
            )
        if self.official and rivals is None:
            raise ConfigError(
                f"tracker {name!r}: it runs its authors' code and weights; put both into a folder as docs/metrics.md "
                "says, and name that with --rivals"
            )
        if not self.maker:
            assert tracker is not None
            return tracker
        module, _, function = self.maker.partition(":")
        make = attrgetter(function)(import_module(f"quest.baselines.{module}"))
        return make(*(() if self.plain else (name, tracker if self.of_weights else rivals)), **self.settings)


_of_weights = partial(Entry, of_weights=True, inputs=EVERYTHING)
_official = partial(Entry, official=True)
_retrained = partial(Entry, retrained=True)

TRACKERS: dict[str, Entry] = {
    "quest": _of_weights("this tracker", ""),
    "quest-pixels": _of_weights("quest without depth", "pixels_only:PixelsOnly.without_depth", inputs=("colours",)),
    "redetect": _of_weights("its finder without queries, every 4th frame", "redetect:Redetect", {"every": 4}),
    "redetect-1": _of_weights("the same in every frame", "redetect:Redetect", {"every": 1}),
    "hold-still": Entry("the first position for ever", "hold_still:HoldStill"),
    "lk": Entry("Lucas-Kanade, one point", "chained:LucasKanade"),
    "lk-grid": Entry("Lucas-Kanade, 5 x 5 points checked backwards", "chained:LucasKanadeGrid"),
    "lk-reinit": Entry("the same, begun anew by its first patch after occlusions", "chained:LucasKanadeAgain"),
    "dis": Entry("dense optical flow, chained", "chained:DenseFlow"),
    "xfeat": Entry("every frame matched to the query's by dense features", "dense_match:DenseMatch.by_xfeat"),
    "dino": _of_weights(
        "the same by tokens of the vision transformer", "dense_match:DenseMatch.by_tokens", inputs=("colours",)
    ),
    "world-pnp": Entry("still in the world, camera by LK and PnP", "hold_still:StillWorld", inputs=("depth",)),
    "world-given": Entry(
        "still in the world, given poses", "hold_still:HoldStill", {"name": "world-given"}, inputs=("depth and poses",)
    ),
    "cotracker3-official": _official("CoTracker3, whole clip", "cotracker:CoTracker", {"online": False}),
    "cotracker3-online-official": _official(
        "CoTracker3, windows of 16 frames", "cotracker:CoTracker", {"online": True}
    ),
    "tapir-official": _official("TAPIR, whole clip", "tapnet:Tapir", {"causal": False, "boots": False}),
    "bootstapir-official": _official("BootsTAPIR, whole clip", "tapnet:Tapir", {"causal": False, "boots": True}),
    "bootstapir-online-official": _official(
        "BootsTAPIR, frame by frame", "tapnet:Tapir", {"causal": True, "boots": True}
    ),
    "tapnext-official": _official("TAPNext, frame by frame", "tapnet:TapNext"),
    "tapnextpp-official": _official("TAPNext++, frame by frame", "tapnet:TapNext"),
    "raft-official": _official("RAFT, chained", "raft:Raft"),
    "raft-3d-official": _official("RAFT-3D, chained; CUDA", "raft:Raft3D", inputs=("depth",)),
    "raft-3d-retrained": _retrained(
        "rigid flow of its kind, chained", "retrained.trackers:FlowTracker", inputs=("depth", "colours")
    ),
    "tapnet-retrained": _retrained("volume of costs of its kind, frame by frame", "retrained.trackers:MatchTracker"),
    "cotracker-retrained": _retrained("refined windows of its kind, 8 frames", "retrained.trackers:RefineTracker"),
}
"""Every tracker by the name that commands and tables call it."""


def line_up(names: Sequence[str], *, weights: str, rivals: Path | None = None) -> tuple[ClipTracker, ...]:
    """The trackers of some names; all that need weights share one network.

    Args:
        names: of :data:`TRACKERS`; each counts once.
        weights: name or file of the weights.
        rivals: folder of the code and weights of official trackers and the weights of retrained ones.

    Raises:
        ConfigError: no tracker of that name, or official code that is not there.
        WeightsError: the weights cannot be loaded, or lack what a tracker needs.
    """
    unknown = [name for name in names if name not in TRACKERS]
    if unknown:
        raise ConfigError(f"tracker {unknown[0]!r}: expected one of {', '.join(TRACKERS)}")
    shared = None
    if any(TRACKERS[name].of_weights for name in names):
        import quest
        from quest.track import Tracker

        shared = quest.load(weights)
        other = [name for name in names if TRACKERS[name].of_weights and name != "quest"]
        if other and not isinstance(shared, Tracker):
            raise WeightsError(f"tracker {other[0]!r}: these weights are of the published network; use a finder's")
    return tuple(TRACKERS[name].build(name, shared, rivals=rivals) for name in dict.fromkeys(names))
