"""Grade of a computed flow: good, fair or not usable, from stated criteria of grid, convergence and balance."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from math import ceil, log2
from typing import Any, Final, Literal

import numpy as np
from scipy.spatial import cKDTree

from vstent.devices.treatment import BARE
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.domain import BRANCH_CELLS, mean_diameter_mm
from vstent.flow.indices import neck_diameter_mm, parent_diameter_mm, residuals
from vstent.flow.lattice.levels import WIDTH, further_levels
from vstent.flow.lattice.setup import CELL_REYNOLDS
from vstent.flow.settings import LATTICE
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import murray_shares
from vstent.kernels.arrays import Floats
from vstent.units import M_PER_MM

Level = Literal["good", "fair", "not usable"]
GOOD: Final = "good"
FAIR: Final = "fair"
NOT_USABLE: Final = "not usable"
COUNTED_SHARE: Final = 0.04
"""Share of the outflow by Murray's law below which an outlet's resistance hardly matters for the sac."""


@dataclass(frozen=True)
class Criterion:
    """One measure of a flow, with the limits of the grades."""

    key: str
    """Key of the measure."""
    good: float
    """Limit of a good flow."""
    fair: float
    """Limit of a fair flow; beyond it the flow is not usable."""
    phrase: str
    """Reason, a format of the measured value."""
    is_at_least: bool = True
    """Whether larger values are better."""

    def level(self, value: float) -> Level:
        """Return the grade by this measure alone."""
        sign = 1 if self.is_at_least else -1
        if sign * value >= sign * self.good:
            return GOOD
        return FAIR if sign * value >= sign * self.fair else NOT_USABLE


CRITERIA: Final = (
    Criterion("cells_across_neck_count", 20.0, 18.0, "{:.0f} cells across the neck"),
    Criterion("cells_across_sac_count", 20.0, 14.0, "{:.0f} cells across the sac"),
    Criterion("cells_across_parent_count", 15.0, 12.0, "{:.0f} cells across the parent artery"),
    Criterion("cells_across_outlet_count", 6.0, 4.0, "{:.1f} cells across an outlet"),
    Criterion("raised_viscosity_fraction", 0.005, 0.05, "viscosity raised in {:.1%} of the sac and neck", False),
    Criterion("unsettled_fraction", 0.03, 0.1, "uncertainty of convergence {:.1%}", False),
    Criterion("neck_imbalance_fraction", 0.04, 0.08, "inflow and outflow of the neck differ by {:.1%}", False),
)
"""Criteria of the grades; their limits are checked by ``benchmarks/grades.py``."""


@dataclass(frozen=True)
class Grade:
    """The grade of a flow and its reasons."""

    level: Level
    """``good``, ``fair`` or ``not usable``: the worst of all criteria."""
    reasons: tuple[str, ...]
    """The criteria that keep it from being good, the worst first."""
    measures: dict[str, float]
    """The measures that it rests on."""


def computation_of(case: FlowCase, field: FlowField) -> dict[str, float | str]:
    """Return what was computed: grid spacing, cells, steps, inflow, Reynolds number of the inlet, and residuals."""
    inlet = case.vessel.inlet
    speed_m_s = float(field.inlets_mL_s[0]) * 1e-6 / (inlet.area_mm2 * M_PER_MM**2)
    viscosity_m2_s = field.blood.kinematic_viscosity_m2_s
    return {
        "grid_spacing_mm": field.finest.cell_size_mm,
        "cells_count": len(field.centers_mm),
        "steps_count": field.steps,
        "inflow_mL_s": field.inflow_mL_s,
        "inlet_reynolds_number_count": speed_m_s * inlet.diameter_mm * M_PER_MM / viscosity_m2_s,
        **residuals(case, field),
        **({"inflow_source": case.inflow_source} if case.inflow_source else {}),
    }


def grade(case: FlowCase, field: FlowField, found: Mapping[str, float]) -> Grade:
    """Grade a flow from its indices (`vstent.flow.indices.indices`) and its grid."""
    return grade_of(measures_of(case, field, found))


def grade_of(measures: Mapping[str, float]) -> Grade:
    """Return the grade that belongs to measures; a measure that is missing is not judged."""
    order: tuple[Level, ...] = (NOT_USABLE, FAIR, GOOD)
    judged = [(one, measures[one.key]) for one in CRITERIA if one.key in measures]
    poor = [(one.level(value), one.phrase.format(value)) for one, value in judged if one.level(value) != GOOD]
    poor.sort(key=lambda pair: order.index(pair[0]))
    level = poor[0][0] if poor else GOOD
    return Grade(level, tuple(phrase for _, phrase in poor), {one.key: value for one, value in judged})


def measures_of(case: FlowCase, field: FlowField, found: Mapping[str, float]) -> dict[str, float]:
    """Return the measures of a flow that its grade rests on; counts are in cells, fractions from 0 to 1."""
    spacing_mm, outlets = field.finest.cell_size_mm, case.vessel.outlets
    measures = {"cells_across_parent_count": mean_diameter_mm(case.vessel) / field.levels[0].cell_size_mm}
    if not case.is_split_given:
        shares = zip(outlets, murray_shares(outlets), strict=True)
        across = min(outlet.diameter_mm for outlet, share in shares if share >= COUNTED_SHARE) / spacing_mm
        further = min(further_levels(case, spacing_mm), max(0, ceil(log2(BRANCH_CELLS / across))))
        measures["cells_across_outlet_count"] = across * WIDTH**further
    if np.isfinite(field.unsettled_fraction):
        measures["unsettled_fraction"] = field.unsettled_fraction
    if case.sac is None or case.ostium is None:
        return measures
    spacing_mm = float(np.median(field.sizes_mm[cKDTree(field.centers_mm).query(case.ostium.vertices_mm)[1]]))
    measures["cells_across_parent_count"] = parent_diameter_mm(case) / spacing_mm
    measures["cells_across_neck_count"] = neck_diameter_mm(case.ostium) / spacing_mm
    measures["cells_across_sac_count"] = float(np.cbrt(6 * abs(case.sac.volume_mm3) / np.pi)) / spacing_mm
    # The part of the neck inflow that neither leaves by the neck nor through one branch of the sac.
    net_mL_s = found["neck_inflow_mL_s"] - found["neck_outflow_mL_s"]
    branches_mL_s: Floats = np.concatenate([[0.0], field.outlets_mL_s, -field.inlets_mL_s])
    imbalance_mL_s = float(np.nanmin(np.abs(net_mL_s - branches_mL_s)))
    measures["neck_imbalance_fraction"] = imbalance_mL_s / max(found["neck_inflow_mL_s"], 1e-12)
    if case.numerics.engine == LATTICE:
        measures["raised_viscosity_fraction"] = _raised_fraction(field, case.sac, case.ostium)
    return measures


def _raised_fraction(field: FlowField, sac: Surface, ostium: Surface) -> float:
    """Return the fraction of the volume of sac and neck in which the viscosity is raised at some time."""
    width_mm = neck_diameter_mm(ostium)
    fastest_m_s = reduce(np.maximum, (moment.speed_m_s for moment in field.moments()))
    middle_mm, reach_mm = sac.vertices_mm.mean(axis=0), np.ptp(sac.vertices_mm, axis=0).max()
    near = np.linalg.norm(field.centers_mm - middle_mm, axis=1) < reach_mm + width_mm
    points_mm, sizes_mm = field.centers_mm[near], field.sizes_mm[near]
    is_raised = fastest_m_s[near] * sizes_mm * M_PER_MM / field.blood.kinematic_viscosity_m2_s > CELL_REYNOLDS
    if not is_raised.any():
        return 0.0  # without a search for the cells
    counts = (ostium.closest(points_mm)[1] < 0.5 * width_mm) | (sac.closest(points_mm)[1] < sizes_mm)
    volume = (sizes_mm[counts] / field.finest.cell_size_mm) ** 3
    return float(np.average(is_raised[counts], weights=volume)) if counts.any() else 0.0


def unusable(metrics: Mapping[str, Any]) -> frozenset[str]:
    """Return the treatments of a study whose changes count for nothing: their flow or the bare one is not usable."""
    levels = {name: one["quality"]["grade"] for name, one in metrics.get("treatments", {}).items() if "quality" in one}
    poor = {name for name, level in levels.items() if level == NOT_USABLE}
    return frozenset(levels if BARE in poor else poor)
