"""Indices of flows that are written down, against their integrals."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from levels import with_values
from shapes import sphere

from vstent.flow.case import FlowField, Level, Phase
from vstent.flow.indices import NEAR_MM, compare, indices, on_sac, ratios
from vstent.flow.settings import Blood
from vstent.geometry.surface import Surface
from vstent.kernels.arrays import Floats

CELL_MM, HALF_MM, SAC_RADIUS_MM = 0.25, 5.0, 2.0
NECK_HALF_MM = 4.0


def plate(half_mm: float, edge_mm: float) -> Surface:
    """A square on z = 0 about the origin, its normals along z."""
    count = round(2 * half_mm / edge_mm) + 1
    ticks = np.linspace(-half_mm, half_mm, count)
    x, y = (a.ravel() for a in np.meshgrid(ticks, ticks, indexing="ij"))
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    lower = np.stack([corner, corner + count, corner + count + 1], axis=1)
    upper = np.stack([corner, corner + count + 1, corner + 1], axis=1)
    return Surface(np.stack([x, y, 0 * x], axis=1), np.concatenate([lower, upper]))


def sac() -> Surface:
    whole = sphere(SAC_RADIUS_MM)
    return Surface(whole.vertices_mm + np.array([0.0, 0.0, 2.5]), whole.faces)


def wall() -> Surface:
    """The sac's, and a plate far wider than its neighbourhood."""
    first, second = sac(), plate(20.0, 0.5)
    faces = np.concatenate([first.faces, second.faces + len(first.vertices_mm)])
    return Surface(np.concatenate([first.vertices_mm, second.vertices_mm]), faces)


def flow(velocity_m_s: Floats, inlets_mL_s: Sequence[float] = (10.0,)) -> FlowField:
    """A flow in a cube of cells; the wall's stress is 2 Pa on the sac, elsewhere 1 Pa more a mm from the neck."""
    surface = wall()
    beyond_mm = np.maximum(np.abs(surface.vertices_mm[:, :2]) - NECK_HALF_MM, 0.0)
    size_Pa = 1.0 + np.linalg.norm(beyond_mm, axis=1)
    size_Pa[: len(sac().vertices_mm)] = 2.0
    stress_Pa = size_Pa[:, None] * np.eye(3)[0]
    told = Blood(), True, 0.0, "", np.zeros(1), 1, 1.0, 1.0
    cells, pressure_Pa = places()[0], np.zeros(len(velocity_m_s))
    through_mL_s = np.array(inlets_mL_s), np.array([sum(inlets_mL_s)])
    values = surface, stress_Pa, 0 * size_Pa, *through_mL_s, 100.0 * through_mL_s[0]
    grid = Level(cells, np.full(3, -HALF_MM), CELL_MM, velocity_m_s, pressure_Pa)
    return FlowField((grid,), *values, np.zeros(1), *told)


def places() -> tuple[np.ndarray, Floats]:
    count = round(2 * HALF_MM / CELL_MM) + 1
    cells = 1 + np.indices((count,) * 3).reshape(3, -1).T  # the index has a free margin
    return cells, -HALF_MM + CELL_MM * cells


def through_neck(mean_m_s: float, slope_m_s_mm: float) -> Floats:
    """Velocity along z that grows along x."""
    x = places()[1][:, 0]
    return (mean_m_s + slope_m_s_mm * x)[:, None] * np.eye(3)[2]


def test_what_goes_through_the_neck_is_its_integral() -> None:
    """In where x > -1 mm: 0.05 (x + 1) m/s over 8 mm of y."""
    found = indices(flow(through_neck(0.05, 0.05)), sac(), plate(NECK_HALF_MM, 0.2))
    inflow, outflow = 0.05 * 8 * 5**2 / 2, 0.05 * 8 * 3**2 / 2
    assert found["neck_inflow_mL_s"] == pytest.approx(inflow, rel=1e-3)
    assert found["neck_outflow_mL_s"] == pytest.approx(outflow, rel=1e-3)
    assert found["inflow_area_fraction"] == pytest.approx(5 / 8, rel=1e-3)
    assert found["turnover_time_s"] == pytest.approx(1e-3 * sac().volume_mm3 / inflow, rel=1e-3)
    assert found["inflow_concentration_index"] == pytest.approx(inflow / 10.0 / (5 / 8), rel=2e-3)


def test_the_neck_is_read_to_the_peak_of_a_jet() -> None:
    """In at 0.05 (1 - x x / 2) m/s where that is positive: linearly between cells it would be 0.8 % less."""
    x = places()[1][:, 0]
    found = indices(flow((0.05 * (1 - x**2 / 2))[:, None] * np.eye(3)[2]), sac(), plate(NECK_HALF_MM, 0.05))
    assert found["neck_inflow_mL_s"] == pytest.approx(0.05 * 8 * 2 * np.sqrt(2) * 2 / 3, rel=5e-4)
    assert found["neck_outflow_mL_s"] == pytest.approx(0.05 * 8 * 2 * (64 / 6 - 4 + np.sqrt(2) * 2 / 3), rel=5e-4)


def test_what_the_sac_holds_is_its_integral() -> None:
    """Mean of (a + b x)^2 in a ball: a a + b b r r / 5."""
    found = indices(flow(through_neck(0.2, 0.02)), sac(), plate(NECK_HALF_MM, 0.2))
    assert found["mean_sac_velocity_m_s"] == pytest.approx(0.2, rel=2e-3)
    assert 0.24 - 0.02 * CELL_MM <= found["max_sac_velocity_m_s"] <= 0.24
    energy_J = 0.5 * 1060 * (0.2**2 + 0.02**2 * SAC_RADIUS_MM**2 / 5) * sac().volume_mm3 * 1e-9
    assert found["sac_kinetic_energy_J"] == pytest.approx(energy_J, rel=5e-3)
    assert found["fast_sac_volume_mm3"] == pytest.approx(sac().volume_mm3)
    assert indices(flow(through_neck(0.07, 0.0)), sac(), plate(NECK_HALF_MM, 0.2))["fast_sac_volume_mm3"] == 0


def test_the_parents_stress_is_that_within_ten_millimetres_of_the_necks_edge() -> None:
    """Of a distance d about a square: area 64 + 32 R + pi R R, integral of d over it 16 R R + 2 pi R R R / 3."""
    found = indices(flow(through_neck(0.1, 0.0)), sac(), plate(NECK_HALF_MM, 0.2))
    assert found["mean_sac_wss_Pa"] == pytest.approx(2.0)
    area_mm2 = 64 + 32 * NEAR_MM + np.pi * NEAR_MM**2
    integral = 16 * NEAR_MM**2 + 2 * np.pi * NEAR_MM**3 / 3
    assert found["parent_wss_Pa"] == pytest.approx(1.0 + integral / area_mm2, rel=0.02)


def test_the_artery_on_the_rim_of_the_neck_is_not_of_the_sac() -> None:
    """A vertex on the curve where a sac leaves the artery lies on both; its stress is the artery's on any grid."""
    whole = sac()
    neck = plate(NECK_HALF_MM, 0.2)
    rim = np.array([[NECK_HALF_MM + away_mm, 0.0, 0.0] for away_mm in (0.0, 0.04, 0.06)])
    beside = Surface(
        np.concatenate([whole.vertices_mm, rim]), np.r_[whole.faces, [len(whole.vertices_mm) + np.arange(3)]]
    )
    assert on_sac(beside, beside, neck)[-3:].tolist() == [False, False, True]
    assert on_sac(beside, whole, neck)[: len(whole.vertices_mm)].all()


def test_quotients_of_a_pulse_are_of_its_means() -> None:
    """The flow comes to a stand-still: the mean of the moments' turnover times would be without bound."""
    neck, steady = plate(NECK_HALF_MM, 0.2), flow(through_neck(0.1, 0.0))
    stress_Pa, still_Pa = steady.wall_shear_stress_Pa, np.zeros(len(steady.centers_mm))
    phases = tuple(
        Phase(
            k,
            np.array([share * 10.0]),
            np.array([share * 10.0]),
            (through_neck(share * 0.1, 0.0),),
            (still_Pa,),
            stress_Pa,
        )
        for k, share in enumerate((1.9, 1.0, 0.1, 1e-6))
    )
    mean = replace(steady, inlets_mL_s=np.array([7.5]), outlets_mL_s=np.array([7.5]), phases=phases)
    found, of_steady = (indices(one, sac(), neck) for one in (mean, steady))
    assert found["neck_inflow_mL_s"] == pytest.approx(0.75 * of_steady["neck_inflow_mL_s"], rel=1e-3)
    assert found["turnover_time_s"] == pytest.approx(of_steady["turnover_time_s"] / 0.75, rel=1e-3)
    assert found["inflow_concentration_index"] == pytest.approx(of_steady["inflow_concentration_index"], rel=1e-3)


def test_the_largest_of_a_pulse_is_that_of_its_moments_and_the_rest_its_mean() -> None:
    """Velocity and stress rise and fall with the inflow, which is 1.9 times its mean at most."""
    steady, shares = flow(through_neck(0.1, 0.0)), np.array([1.9, 1.0, 0.1])
    still_Pa, stress_Pa = np.zeros(len(steady.centers_mm)), steady.wall_shear_stress_Pa
    phases = tuple(
        Phase(
            k,
            np.array([share * 10.0]),
            np.array([share * 10.0]),
            (through_neck(share * 0.1, 0.0),),
            (still_Pa,),
            share * stress_Pa,
        )
        for k, share in enumerate(shares)
    )
    pulse, of_steady = (
        indices(one, sac(), plate(NECK_HALF_MM, 0.2)) for one in (replace(steady, phases=phases), steady)
    )
    for key in ("max_sac_velocity_m_s", "max_sac_wss_Pa"):
        assert pulse[key] == pytest.approx(1.9 * of_steady[key], rel=1e-6)
    for key in ("mean_sac_velocity_m_s", "mean_sac_wss_Pa", "parent_wss_Pa", "neck_inflow_mL_s"):
        assert pulse[key] == pytest.approx(shares.mean() * of_steady[key], rel=1e-6)
    assert pulse["sac_kinetic_energy_J"] == pytest.approx((shares**2).mean() * of_steady["sac_kinetic_energy_J"])


def test_of_a_flow_that_moves_sizes_are_meant_not_the_size_of_the_mean() -> None:
    """Its mean goes into the sac at 0.02 m/s; what goes to and fro besides is told by its swing."""
    still = flow(through_neck(0.02, 0.0))
    moving = with_values(still, mean_speed_m_s=np.full(len(still.centers_mm), 0.09))
    found = indices(
        replace(moving, mean_shear_Pa=3.0 * still.shear_Pa, neck_inflow_mL_s=5.0), sac(), plate(NECK_HALF_MM, 0.2)
    )
    assert found["mean_sac_velocity_m_s"] == pytest.approx(0.09)
    assert found["fast_sac_volume_mm3"] == pytest.approx(sac().volume_mm3)
    assert found["mean_sac_wss_Pa"] == pytest.approx(6.0)
    assert found["neck_inflow_mL_s"] == 5.0
    assert found["neck_inflow_mL_s"] - found["neck_outflow_mL_s"] == pytest.approx(0.02 * 64)


def test_of_a_pulse_on_a_finer_mesh_each_moments_inflow_is_what_that_mesh_told() -> None:
    steady = flow(through_neck(0.02, 0.0))
    moment = steady.inlets_mL_s, steady.outlets_mL_s, (through_neck(0.02, 0.0),), (steady.pressure_Pa,)
    phases = tuple(Phase(k, *moment, steady.wall_shear_stress_Pa, told) for k, told in enumerate((2.0, 5.0)))
    found = indices(replace(steady, phases=phases, neck_inflow_mL_s=9.0), sac(), plate(NECK_HALF_MM, 0.2))
    assert found["neck_inflow_mL_s"] == 3.5


def test_ratios_are_of_what_both_have_and_nothing_is_divided_by_zero() -> None:
    assert ratios({"a": 2.0, "b": 0.0, "c": 1.0}, {"a": 1.0, "b": 3.0}) == {"a_ratio": 0.5}


def test_compared_flows_have_both_values_and_their_ratio() -> None:
    healthy = SimpleNamespace(aneurysms=())
    found = compare(healthy, *(flow(through_neck(0.1, 0.0), inlets_mL_s) for inlets_mL_s in ([10.0, 0.0], [4.0, 2.0])))
    assert found["inlet_flow_mL_s"] == (10.0, 4.0, 0.4)
    assert found["inlet_2_flow_mL_s"][:2] == (0.0, 2.0)
    assert np.isnan(found["inlet_2_flow_mL_s"].ratio)
    assert "neck_inflow_mL_s" not in found


def test_further_surfaces_have_their_inflow_scaled_as_that_of_the_neck_is() -> None:
    steady, half = flow(through_neck(0.05, 0.05)), {"below": plate(NECK_HALF_MM / 2, 0.2)}
    found = indices(steady, sac(), plate(NECK_HALF_MM, 0.2), half)
    assert found["below_mL_s"] == pytest.approx(0.05 * 4 * 3**2 / 2, rel=1e-3)  # in where x > -1 mm, over 4 mm of y
    told = indices(replace(steady, neck_inflow_mL_s=10.0), sac(), plate(NECK_HALF_MM, 0.2), half)
    assert told["neck_inflow_mL_s"] == 10.0
    assert told["below_mL_s"] == pytest.approx(10.0 * found["below_mL_s"] / found["neck_inflow_mL_s"])
