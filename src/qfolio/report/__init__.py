"""A training report: one self-contained page, its figures as PNG files and an animation."""

from qfolio.report.data import Curve, Episode, Maps, ReportData
from qfolio.report.training import write_report

__all__ = ["Curve", "Episode", "Maps", "ReportData", "write_report"]
