"""Boundary conditions of the openings: what the settings say, and that each type keeps its value and the mass."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from vstent import phantoms
from vstent.anatomy.trace import trace
from vstent.flow.ends import MEAN_INLET_SPEED_M_S, End, FlowRate, Inflow, Pressure, ends_of
from vstent.flow.problem import vessel_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.geometry.vessel import Vessel

INFLOW_ML_S = 1.0
SETTINGS = FlowSettings(inflow_mL_s=INFLOW_ML_S, numerics=Numerics(cell_size_mm=0.4, tolerance=0.002))


@cache
def fork() -> Vessel:
    """A tube with a branch: one inlet and two outlets, the second 2.4 mm wide."""
    straight = phantoms.tube(length_mm=14.0, radius_mm=2.0)
    phantom = phantoms.with_branch(straight, abscissa_mm=6.0, direction=[1, 0, 1], radius_mm=1.2, length_mm=7.0)
    return trace(Vessel(phantoms.phantom_surface(phantom)))


def test_murray_gives_all_outlets_but_the_widest_their_share_of_the_cubes_of_the_diameters() -> None:
    inlet, wide, narrow = fork().openings
    share = narrow.diameter_mm**3 / (wide.diameter_mm**3 + narrow.diameter_mm**3)
    assert 0.1 < share < 0.3
    ends = ends_of(fork(), replace(SETTINGS, outlets="murray"))
    assert ends == (Inflow(INFLOW_ML_S), Pressure(0.0), FlowRate(pytest.approx(share * INFLOW_ML_S)))
    assert ends_of(fork(), SETTINGS) == (Inflow(INFLOW_ML_S), Pressure(0.0), Pressure(0.0))
    by_default = ends_of(fork(), FlowSettings())
    assert by_default[0] == Inflow(pytest.approx(MEAN_INLET_SPEED_M_S * inlet.area_mm2))


def test_resistances_matter_unless_every_flow_is_given() -> None:
    free, split = (vessel_case(fork(), replace(SETTINGS, outlets=word)) for word in ("zero_pressure", "murray"))
    assert not free.is_split_given
    assert split.is_split_given
    assert vessel_case(trace(Vessel(phantoms.phantom_surface(phantoms.tube())))).is_split_given


@pytest.mark.parametrize(
    "ends",
    [
        (Inflow(INFLOW_ML_S), Pressure(), FlowRate(0.4)),
        (Inflow(INFLOW_ML_S), FlowRate(0.7), Pressure()),
        (Inflow(INFLOW_ML_S), Pressure(), Pressure(1.0)),
    ],
)
def test_every_end_keeps_its_value_and_what_enters_leaves(ends: tuple[End, ...]) -> None:
    field = simulate_case(replace(vessel_case(fork(), SETTINGS), ends=ends))
    assert field.is_converged
    assert field.inlets_mL_s[0] == pytest.approx(INFLOW_ML_S, rel=2e-3)
    assert field.outlets_mL_s.sum() == pytest.approx(field.inflow_mL_s, rel=3e-3)
    for end, found_mL_s in zip(ends[1:], field.outlets_mL_s, strict=True):
        if isinstance(end, FlowRate):
            assert found_mL_s == pytest.approx(end.mean_mL_s, rel=3e-3)


def test_a_pressure_at_an_outlet_sends_the_blood_to_the_other() -> None:
    even, level, higher = (
        simulate_case(replace(vessel_case(fork(), SETTINGS), ends=(Inflow(INFLOW_ML_S), *map(Pressure, pressures_Pa))))
        for pressures_Pa in ((0.0, 0.0), (30.0, 30.0), (30.0, 31.0))
    )
    # A pressure common to all outlets shifts that of the vessel and moves no blood.
    np.testing.assert_allclose(level.outlets_mL_s, even.outlets_mL_s, rtol=2e-3)
    np.testing.assert_allclose(level.pressure_Pa - even.pressure_Pa, 30.0, rtol=0.01)
    assert higher.outlets_mL_s[1] < 0.92 * level.outlets_mL_s[1]
    assert higher.inlet_pressure_Pa[0] > level.inlet_pressure_Pa[0] + 0.1
