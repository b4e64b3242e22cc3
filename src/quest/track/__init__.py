"""The tracker that a user holds: whole clips and streams share one step function."""

from quest.track.settings import TrackerConfig
from quest.track.stream import Stream, StreamState
from quest.track.tracker import Tracker, load

__all__ = ["Stream", "StreamState", "Tracker", "TrackerConfig", "load"]
