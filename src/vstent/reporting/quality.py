"""Grades of the flows as the reports, the page and the terminal state them."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from vstent.devices.treatment import BARE
from vstent.flow.grade import FAIR, GOOD, NOT_USABLE
from vstent.reporting.quantities import format_value

MARKS: Final = {GOOD: "✓", FAIR: "~", NOT_USABLE: "✗"}
"""Sign of every grade, so that color alone never carries it."""
OF_GRADES: Final = (
    "The grade of a flow follows from its grid, convergence and balance. A flow that is not usable shows no changes: "
    "use a finer grid."
)


class Quality(NamedTuple):
    """Grade of one flow in words."""

    name: str
    """Name of the treatment, and which of its flows where the artery yields."""
    title: str
    """What is graded, with the display name of the treatment."""
    grade: str
    """``good``, ``fair`` or ``not usable``."""
    reasons: str
    """What keeps it from being good; empty for a good flow."""
    computation: str
    """Grid spacing, cells, steps, inflow, Reynolds number and residual of mass."""

    @property
    def mark(self) -> str:
        """Sign of the grade."""
        return MARKS[self.grade]

    @property
    def sentence(self) -> str:
        """Display name, grade and reasons in one sentence."""
        return f"{self.title}: {self.mark} {self.grade}{f' ({self.reasons})' if self.reasons else ''}."


def qualities(metrics: Mapping[str, Any], titles: Mapping[str, str]) -> list[Quality]:
    """Return the grade of every flow that has one, the flow without a device first; `titles` are of treatments."""
    treatments, found = metrics.get("treatments", {}), []
    flows = [(BARE, "without a device", treatments.get(BARE, {}))]
    for name, title in titles.items():
        treatment = treatments.get(name, {})
        yielded = treatment.get("straightening", {})
        flows += [
            (name, f"with {title}", treatment),
            (f"{name}, straightened", f"with {title} in the straightened artery", yielded),
            (f"{name}, straightened, bare", f"without {title} in the straightened artery", yielded.get("bare", {})),
        ]
    for name, what, flow in flows:
        if "quality" in flow:
            one, which = flow["quality"], f"Grid and convergence {what}"
            spacing, inflow = (format_value(key, one[key]) for key in ("grid_spacing_mm", "inflow_mL_s"))
            inflow += f" ({60 * one['inflow_mL_s']:.0f} mL/min)"
            source = f", {one['inflow_source']}" if "inflow_source" in one else ""
            computation = (
                f"grid spacing {spacing}, {one['cells_count']:,} cells, {one['steps_count']:,} time steps, inflow "
                f"{inflow}{source} (Reynolds number {one['inlet_reynolds_number_count']:.0f}), mass residual "
                f"{100 * abs(one['mass_residual_fraction']):.2f}\u202f%"
            )
            found.append(Quality(name, which, one["grade"], "; ".join(one["reasons"]), computation))
    return found
