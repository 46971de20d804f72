"""Contrast in every kind of flow: pulsatile, with a refined sac, and brought from an OpenFOAM mesh."""

from dataclasses import replace

import numpy as np
import pytest
from levels import with_values

from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.angiography.angiogram import AngiogramSettings, injection
from vstent.angiography.bolus import Bolus
from vstent.angiography.washout import wash_out
from vstent.flow import sampling
from vstent.flow.case import FlowField, Phase
from vstent.flow.openfoam import scatter
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings, Numerics, Region
from vstent.flow.simulation import simulate_case
from vstent.geometry.vessel import Anatomy, Vessel

SPACING_MM = 0.3
SETTINGS = AngiogramSettings(bolus=Bolus(amount_mL=0.5, rate_mL_s=1.0), window_s=3.0)


@pytest.fixture(scope="module")
def anatomy() -> Anatomy:
    artery = phantoms.with_sac(
        phantoms.tube(length_mm=14.0, radius_mm=1.5),
        abscissa_mm=7.0,
        width_mm=4.0,
        neck_mm=3.0,
        direction=np.array([1.0, 0.0, 0.0]),
    )
    return restore(trace(Vessel(phantoms.phantom_surface(artery, edge_mm=0.4))))


@pytest.fixture(scope="module")
def uniform(anatomy: Anatomy) -> FlowField:
    return flow(anatomy)


def flow(anatomy: Anatomy, spacing_mm: float = SPACING_MM, *, refine: tuple[Region, ...] = ()) -> FlowField:
    settings = FlowSettings(inflow_mL_s=2.0, numerics=Numerics(cell_size_mm=spacing_mm, refine=refine))
    return simulate_case(flow_case(anatomy, (), settings))


def pulse_of(field: FlowField, factors: np.ndarray, period_s: float) -> FlowField:
    """A flow whose velocity is everywhere a multiple of a steady one."""
    times = period_s * np.arange(len(factors)) / len(factors)
    still = (field.pressure_Pa,), field.wall_shear_stress_Pa
    phases = tuple(
        Phase(t, s * field.inlets_mL_s, s * field.outlets_mL_s, (s * field.velocity_m_s,), *still)
        for t, s in zip(times, factors, strict=True)
    )
    return replace(field, phases=phases)


def meshed(field: FlowField) -> FlowField:
    """The flow after its transfer to the points of a mesh and back, as that of OpenFOAM is brought to the grid."""
    spread = np.random.default_rng(1).uniform(-0.5, 0.5, (2, *field.centers_mm.shape)) * field.finest.cell_size_mm
    points_mm = (field.centers_mm + spread).reshape(-1, 3)
    at_rest_mm = field.wall.vertices_mm
    known = np.concatenate([sampling.values_at(field, points_mm)[0], np.zeros_like(at_rest_mm)])
    return with_values(field, velocity_m_s=scatter.fits(np.r_[points_mm, at_rest_mm], field.centers_mm) @ known)


def sac_curve(anatomy: Anatomy, field: FlowField) -> np.ndarray:
    """The mean concentration (t,) in the sac; that all contrast is accounted for and bounded is asserted."""
    ready = injection(flow_case(anatomy, ()), field, SETTINGS)
    sac, found = ready.grid.sac, []
    for _, values in ready.frames():
        assert values.min() >= -1e-6
        assert values.max() <= ready.transport.upper * (1 + 1e-3)
        found.append(values[sac].mean())
    balance = ready.transport.balance()
    assert balance.error_fraction < 1e-3
    assert balance.entered == pytest.approx(1e3 * 0.5 * 300.0, rel=5e-3)  # 0.5 mL of 300 mg/mL
    return np.array(found)


def test_a_pulse_is_conserved_and_washes_the_sac_as_its_volume_has_passed(anatomy: Anatomy, uniform: FlowField) -> None:
    """Where the velocity is s(t) times a steady one, the washout is that of the steady flow at the integral of s."""
    period_s, turn = 0.4, 2 * np.pi * np.arange(20) / 20
    pulse = pulse_of(uniform, 1 + 0.5 * np.sin(turn), period_s)
    sac_curve(anatomy, pulse)
    case = flow_case(anatomy, ())
    steady, found = (wash_out(*injection(case, field, SETTINGS).grid.near, end_s=5.0) for field in (uniform, pulse))
    passed_s = found.time_s + 0.5 * period_s / (2 * np.pi) * (1 - np.cos(2 * np.pi * found.time_s / period_s))
    wanted = np.interp(passed_s, steady.time_s, steady.left_fraction)
    early = passed_s < 3.0
    assert found.left_fraction[early] == pytest.approx(wanted[early], abs=0.01)


def test_contrast_is_conserved_and_bounded_in_a_refined_sac(anatomy: Anatomy) -> None:
    refined = flow(anatomy, 0.21, refine=("sac",))  # twice that elsewhere, nearly the coarsest grid of this artery
    assert sac_curve(anatomy, refined).max() > 0


def test_a_flow_from_a_mesh_agrees_with_that_of_the_grid(anatomy: Anatomy, uniform: FlowField) -> None:
    found, wanted = sac_curve(anatomy, meshed(uniform)), sac_curve(anatomy, uniform)
    assert np.abs(found - wanted).max() < 0.15 * wanted.max()
