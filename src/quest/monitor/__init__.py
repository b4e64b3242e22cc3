"""Drift signals, calibration, sequential alarms: knows when a query silently follows something else."""

from quest.monitor.alarm import Alarm, Verdict
from quest.monitor.calibration import Calibration
from quest.monitor.conformal import Budget
from quest.monitor.monitor import Monitor, MonitorState
from quest.monitor.signals import SIGNALS, Signals

__all__ = ["SIGNALS", "Alarm", "Budget", "Calibration", "Monitor", "MonitorState", "Signals", "Verdict"]
