"""Grades of flows that are written down: every measure against its value, every limit from both sides."""

from dataclasses import replace

import numpy as np
import pytest

from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.flow.case import FlowCase, FlowField, Level
from vstent.flow.grade import CRITERIA, FAIR, GOOD, NOT_USABLE, computation_of, grade, grade_of, measures_of
from vstent.flow.problem import flow_case, vessel_case
from vstent.flow.settings import Blood, FlowSettings, Numerics
from vstent.geometry.vessel import Vessel
from vstent.kernels.arrays import Floats

SPACING_MM = 0.25
BALANCED = {"neck_inflow_mL_s": 0.5, "neck_outflow_mL_s": 0.5}
LIMITS = [(one, limit) for one in CRITERIA for limit in ("good", "fair")]


@pytest.fixture(scope="module")
def case() -> FlowCase:
    """A straight artery of 4 mm with a sac of 6 mm."""
    phantom = phantoms.with_sac(phantoms.tube(length_mm=30.0), abscissa_mm=15.0, width_mm=6.0, neck_mm=4.0)
    anatomy = restore(trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3))))
    return flow_case(anatomy, (), FlowSettings(numerics=Numerics(cell_size_mm=SPACING_MM)))


def uniform(case: FlowCase, speed_m_s: float, **changes: object) -> FlowField:
    """Return the same velocity everywhere in a box around the vessel."""
    low, high = case.vessel.lumen.vertices_mm.min(axis=0), case.vessel.lumen.vertices_mm.max(axis=0)
    shape = np.ceil((high - low) / SPACING_MM).astype(int) + 1
    cells = np.indices(tuple(shape)).reshape(3, -1).T
    velocity = np.full((len(cells), 3), [0.0, 0.0, speed_m_s])
    n = len(case.vessel.lumen.vertices_mm)
    none: Floats = np.zeros(1)
    field = FlowField(
        *((Level(cells, low, SPACING_MM, velocity, np.zeros(len(cells))),), case.vessel.lumen),
        *(np.zeros((n, 3)), np.zeros(n)),
        *(np.array([3.0]), np.array([3.0]), none, none, Blood(), True, 0.01, "", none, 7, 1.0, 1.0),
    )
    return replace(field, **changes)  # type: ignore[arg-type]


def test_cells_are_counted_across_neck_sac_and_artery(case: FlowCase) -> None:
    found = measures_of(case, uniform(case, 0.1), BALANCED)
    assert found["cells_across_parent_count"] == pytest.approx(4.0 / SPACING_MM, rel=0.02)
    assert case.sac is not None
    volume_mm3 = abs(case.sac.volume_mm3)
    assert np.pi / 6 * (found["cells_across_sac_count"] * SPACING_MM) ** 3 == pytest.approx(volume_mm3)
    assert case.ostium is not None
    assert np.pi / 4 * (found["cells_across_neck_count"] * SPACING_MM) ** 2 == pytest.approx(case.ostium.area_mm2)
    assert "cells_across_outlet_count" not in found  # all blood leaves by the only one


def test_a_branch_counts_where_its_resistance_decides(case: FlowCase) -> None:
    forked = phantoms.phantom_surface(phantoms.bifurcation(), edge_mm=0.3)
    vessel = trace(Vessel(forked))
    fork = vessel_case(vessel, FlowSettings(numerics=Numerics(cell_size_mm=SPACING_MM)))
    field = uniform(fork, 0.1, outlets_mL_s=np.array([1.5, 1.5]), outlet_pressure_Pa=np.zeros(2))
    found = measures_of(fork, field, {})
    narrowest_mm = min(outlet.diameter_mm for outlet in vessel.outlets)
    assert found["cells_across_outlet_count"] == narrowest_mm / SPACING_MM
    wide, narrow = vessel.outlets[0], replace(vessel.outlets[1], area_mm2=0.02 * vessel.outlets[0].area_mm2)
    stub = replace(fork, vessel=replace(vessel, openings=(vessel.inlet, wide, narrow)))
    assert measures_of(stub, field, {})["cells_across_outlet_count"] == wide.diameter_mm / SPACING_MM
    split = vessel_case(vessel, FlowSettings(outlets="murray"))
    assert "cells_across_outlet_count" not in measures_of(split, field, {})


@pytest.mark.parametrize(("speed_m_s", "expected"), [(1.12, 0.0), (1.14, 1.0)])
def test_viscosity_is_raised_above_a_grid_reynolds_number_of_75(
    case: FlowCase, speed_m_s: float, expected: float
) -> None:
    """75 is reached at 75 x 0.004 / 1060 / 0.25e-3 = 1.132 m/s."""
    assert measures_of(case, uniform(case, speed_m_s), BALANCED)["raised_viscosity_fraction"] == expected


def test_what_leaves_through_a_branch_of_the_sac_is_no_imbalance(case: FlowCase) -> None:
    into_branch = {"neck_inflow_mL_s": 1.0, "neck_outflow_mL_s": 0.6}
    without = measures_of(case, uniform(case, 0.1), into_branch)
    assert without["neck_imbalance_fraction"] == pytest.approx(0.4)
    field = uniform(case, 0.1, outlets_mL_s=np.array([2.6, 0.39]), outlet_pressure_Pa=np.zeros(2))
    assert measures_of(case, field, into_branch)["neck_imbalance_fraction"] == pytest.approx(0.01)


@pytest.mark.parametrize(("criterion", "limit"), LIMITS, ids=[f"{one.key}-{limit}" for one, limit in LIMITS])
def test_every_limit_parts_two_grades(criterion, limit: str) -> None:
    best = {one.key: 1e3 if one.is_at_least else 0.0 for one in CRITERIA}
    assert grade_of(best).level == GOOD
    assert grade_of(best).reasons == ()
    value, sign = getattr(criterion, limit), 1 if criterion.is_at_least else -1
    inside, outside = (grade_of(best | {criterion.key: value + sign * step * value}) for step in (1e-6, -1e-6))
    assert (inside.level, outside.level) == ((GOOD, FAIR) if limit == "good" else (FAIR, NOT_USABLE))
    assert len(outside.reasons) == 1


def test_the_worst_criterion_decides_and_is_named_first() -> None:
    found = grade_of({"cells_across_sac_count": 15.0, "cells_across_neck_count": 5.0, "unsettled_fraction": 0.5})
    assert found.level == NOT_USABLE
    assert found.reasons[-1] == "15 cells across the sac"
    assert set(found.reasons[:2]) == {"5 cells across the neck", "uncertainty of convergence 50.0%"}


def test_what_was_computed_is_stated(case: FlowCase) -> None:
    found = computation_of(case, uniform(case, 0.1))
    assert found["grid_spacing_mm"] == SPACING_MM
    assert found["steps_count"] == 7
    inlet = case.vessel.inlet
    speed_m_s = 3.0e-6 / (inlet.area_mm2 * 1e-6)
    reynolds = speed_m_s * inlet.diameter_mm * 1e-3 * 1060 / 0.004
    assert found["inlet_reynolds_number_count"] == pytest.approx(reynolds)


def test_a_flow_is_graded_by_its_measures(case: FlowCase) -> None:
    field = uniform(case, 0.1)
    assert grade(case, field, BALANCED) == grade_of(measures_of(case, field, BALANCED))
