"""Calibration, a sequential statistic, alarms: knows when a query silently follows something else."""

from quest.monitor.calibration import Calibration as Calibration
from quest.monitor.calibration import Inputs as Inputs
from quest.monitor.calibration import probability as probability
from quest.monitor.calibration import read_calibrations as read_calibrations
from quest.monitor.calibration import write_calibrations as write_calibrations
from quest.monitor.conformal import Budget as Budget
from quest.monitor.monitor import Alarm as Alarm
from quest.monitor.monitor import Monitor as Monitor
from quest.monitor.monitor import MonitorState as MonitorState
from quest.monitor.monitor import Verdict as Verdict
