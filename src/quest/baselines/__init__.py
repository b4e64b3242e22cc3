"""Correspondence trackers behind the tracker's interface; they answer point queries only."""

from quest.baselines.hold_still import HoldStill
from quest.baselines.lucas_kanade import LucasKanade

__all__ = ["HoldStill", "LucasKanade"]
