"""Rank the treatments of a study together: inflow, velocity, metal, fit, and the flow that jailed branches lose."""

from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any, Final

from vstent.deployment.coverage import UNION
from vstent.devices.treatment import BARE
from vstent.flow.grade import NOT_USABLE, unusable
from vstent.plan.criteria import Criteria, parse
from vstent.plan.rank import graded

FLOWS: Final = {
    "sac_velocity_change_fraction": "mean_sac_velocity_m_s_ratio",
    "neck_inflow_change_fraction": "neck_inflow_mL_s_ratio",
}
"""Measure of a treatment, and the ratio of flows from which it follows."""
STRAIGHTENED: Final = "straightened_sac_velocity_change_fraction"
"""Measure of a treatment in an artery that has yielded to it; it has no grade."""
WORST: Final = ("mean_wall_gap_mm", "protrusion_mm")
"""Measures of fit, of which that of the implant that fits worst counts."""
MEASURES: Final = (*FLOWS, "neck_coverage_fraction", "metal_in_artery_mm2", "worst_branch_change_fraction", *WORST)
"""Measures for criteria."""


@cache
def treatment_criteria() -> Criteria:
    """Return the criteria for treatments, read from ``vstent/plan/treatments.toml``."""
    return parse(files("vstent.plan").joinpath("treatments.toml").read_text(encoding="utf-8"), known=MEASURES)


def rank_treatments(treatments: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rank treatments by their metrics, each with its flow; those without a flow are left out.

    A treatment whose flow, or the flow without a device, is not usable comes last and has no measures.

    Parameters
    ----------
    treatments : metrics of the treatments by name, as in ``metrics.json``.

    Returns
    -------
    rows : the best first: name, score from 0 to 1, whether no criterion rules it out, the reasons in words, the
        measures, and the relative change of the flow of every jailed branch by name.
    """
    rows: list[dict[str, Any]] = []
    poor = unusable({"treatments": treatments})
    for name, treatment in treatments.items():
        change = treatment.get("change", {})
        if not change:
            continue
        if {name, BARE} & poor:  # a treatment may have no grade where the flow without a device is not usable
            reason = f"Not ranked: the flow {'without a device' if BARE in poor else 'with it'} is not usable."
            told = {"treatment": name, "score": 0.0, "is_suitable": False, "reason": reason}
            rows.append(told | {"jailed_branches": {}})
            continue
        implants, both = treatment["implants"].values(), treatment.get("straightening", {})
        measures = {key: change[ratio] - 1 for key, ratio in FLOWS.items() if ratio in change}
        if (coverage := treatment.get("together", {}).get(UNION)) is not None:
            measures["neck_coverage_fraction"] = coverage
        measures["metal_in_artery_mm2"] = sum(one.get("metal_in_artery_mm2", 0.0) for one in implants)
        for key in WORST:
            if values := [one[key] for one in implants if key in one]:
                measures[key] = max(values)
        jailed = {
            role: change[f"{role}_flow_mL_s_ratio"] - 1
            for role in treatment.get("jailed_branches", ())
            if f"{role}_flow_mL_s_ratio" in change
        }
        if jailed:
            measures["worst_branch_change_fraction"] = min(jailed.values())
        if "change" in both and both["quality"]["grade"] != NOT_USABLE:
            measures[STRAIGHTENED] = both["change"]["mean_sac_velocity_m_s_ratio"] - 1
        grades, score, reason = graded(treatment_criteria().items, measures)
        told = {"score": score, "is_suitable": all(grades.values()), "reason": reason}
        rows.append({"treatment": name} | told | measures | {"jailed_branches": jailed})
    return sorted(rows, key=lambda row: (not row["is_suitable"], -row["score"]))
