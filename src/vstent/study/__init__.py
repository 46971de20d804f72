"""Study of one case: from an input file and `Settings` to a case folder with all results; a second run resumes.

``pipeline.py`` contains the functions to call, ``stages.py`` the stages in their order.
"""

from vstent.study.pipeline import refine_flow, restore_vessel, run, trace_vessel
from vstent.study.types import CaseResult, Placing, Progress, Settings

__all__ = ["CaseResult", "Placing", "Progress", "Settings", "refine_flow", "restore_vessel", "run", "trace_vessel"]
