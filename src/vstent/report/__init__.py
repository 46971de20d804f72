"""The report of a case: one HTML file with its viewer, its pictures and every number, and nothing from a network."""

from vstent.report.page import report

__all__ = ["report"]
