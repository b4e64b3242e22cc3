"""Calibration, a sequential statistic, alarms: knows when a query silently follows something else."""

from quest.monitor.alarm import Alarm, Verdict
from quest.monitor.calibration import Calibration, probability
from quest.monitor.calibration_file import Inputs, read_calibrations, write_calibrations
from quest.monitor.conformal import Budget
from quest.monitor.monitor import Monitor, MonitorState

__all__ = [
    "Alarm",
    "Budget",
    "Calibration",
    "Inputs",
    "Monitor",
    "MonitorState",
    "Verdict",
    "probability",
    "read_calibrations",
    "write_calibrations",
]
