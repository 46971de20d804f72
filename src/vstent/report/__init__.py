"""The reports of a case and of a cohort: one HTML file each, with every number, and nothing from a network."""

from vstent.report.cohort import cohort_report
from vstent.report.page import report

__all__ = ["cohort_report", "report"]
