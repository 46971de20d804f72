"""Study of one patient: an input file and `Settings` in, a case folder with all results out; a rerun resumes.

Open ``pipeline.py`` first; ``stages.py`` holds the stages in their order.
"""

from vstent.study.pipeline import refine_flow, restore_vessel, run, trace_vessel
from vstent.study.types import CaseResult, OnProgress, Progress, Settings

__all__ = ["CaseResult", "OnProgress", "Progress", "Settings", "refine_flow", "restore_vessel", "run", "trace_vessel"]
