"""The tracker that a user holds: whole clips and streams share one step function."""

from quest.track.settings import TrackerConfig
from quest.track.state import StreamState
from quest.track.stream import Stream
from quest.track.tracker import Tracker, load

__all__ = ["Stream", "StreamState", "Tracker", "TrackerConfig", "load"]
