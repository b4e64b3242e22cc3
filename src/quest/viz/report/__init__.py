"""A page about one run of ``quest track``: what happened, plots, video and settings in one HTML file."""

from __future__ import annotations

from quest.viz.report.page import write_report as write_report
from quest.viz.report.plots import Drift as Drift
from quest.viz.report.run_record import Recorded as Recorded
from quest.viz.report.run_record import RunRecord as RunRecord
from quest.viz.report.run_record import read_run as read_run
from quest.viz.report.run_record import write_run as write_run
