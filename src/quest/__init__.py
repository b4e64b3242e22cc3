"""QueST follows entities on articulated objects in RGB-D video with persistent semantic queries."""

from __future__ import annotations

from typing import TYPE_CHECKING

from quest.errors import QuestError
from quest.types import LABELS, Camera, Clip, Frame, Joints, Query, State, Tracks

if TYPE_CHECKING:
    from quest.data.recording import read_recording as read

    # Of weights of the published network it gives a PaperTracker, whose only door is the same ``track``.
    from quest.track import Stream, StreamState, Tracker, load

__version__ = "0.1.0"
__all__ = [
    "LABELS",
    "Camera",
    "Clip",
    "Frame",
    "Joints",
    "Query",
    "QuestError",
    "State",
    "Stream",
    "StreamState",
    "Tracker",
    "Tracks",
    "load",
    "read",
]


def __getattr__(name: str) -> object:
    """The tracker and the readers are imported when they are first asked for, because they bring torch and more."""
    if name == "read":
        from quest.data.recording import read_recording as read

        return read
    if name == "load":
        from quest.paper.tracker import load

        return load
    if name in {"Stream", "StreamState", "Tracker"}:
        from quest import track

        return getattr(track, name)
    raise AttributeError(f"module 'quest' has no attribute {name!r}")
