"""A page about one run of ``quest track``: what happened, plots, video and settings in one HTML file."""

from quest.viz.report.page import Recorded, RunRecord, read_run, write_report, write_run
from quest.viz.report.plots import Drift

__all__ = ["Drift", "Recorded", "RunRecord", "read_run", "write_report", "write_run"]
