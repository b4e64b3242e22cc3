"""Other trackers behind the tracker's interface: correspondence, and QueST's network without queries or anchors."""

from quest.baselines.flow_chain import FlowChain
from quest.baselines.hold_still import HoldStill
from quest.baselines.lucas_kanade import LucasKanade
from quest.baselines.redetect import Detector, Redetect

__all__ = ["Detector", "FlowChain", "HoldStill", "LucasKanade", "Redetect"]
