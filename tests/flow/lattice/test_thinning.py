"""Blood that thins with the shear rate, in a pipe, against the integral of its law."""

import numpy as np
import pytest
from scipy.optimize import brentq

from vstent import phantoms
from vstent.anatomy.trace import trace
from vstent.flow import domain, sampling
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.problem import vessel_case
from vstent.flow.settings import Blood, CarreauYasuda, FlowSettings, Numerics, Waveform
from vstent.flow.simulation import simulate_case
from vstent.flow.wall_stress import wall_stress
from vstent.geometry.vessel import Vessel
from vstent.kernels import directions

RADIUS_M, LENGTH_MM, INFLOW_ML_S = 2e-3, 14.0, 0.3
BLOOD = Blood(viscosity_Pa_s=0.00345, thinning=CarreauYasuda())
R_M = np.linspace(0.0, RADIUS_M, 801)


def profile_m_s(gradient_Pa_m: float) -> np.ndarray:
    """Axial speed at `R_M`: mu(g) g = gradient r / 2 at every radius, and no slip."""
    stress_Pa = 0.5 * gradient_Pa_m * R_M
    rate = [brentq(lambda g, s=s: BLOOD.viscosity_at_Pa_s(np.array(g)) * g - s, 0.0, 1e5) for s in stress_Pa]
    steps = 0.5 * (np.array(rate)[1:] + np.array(rate)[:-1]) * np.diff(R_M)
    return np.r_[np.cumsum(steps[::-1])[::-1], 0.0]


def flow_mL_s(gradient_Pa_m: float) -> float:
    return float(2e6 * np.pi * np.trapezoid(profile_m_s(gradient_Pa_m) * R_M, R_M))


def test_thinning_blood_flows_in_a_pipe_as_its_law_has_it() -> None:
    gradient_Pa_m = brentq(lambda g: flow_mL_s(g) - INFLOW_ML_S, 10.0, 5000.0, rtol=1e-4)
    exact = profile_m_s(gradient_Pa_m)
    poiseuille_m_s = 2 * INFLOW_ML_S * 1e-6 / (np.pi * RADIUS_M**2)
    assert exact[0] < 0.93 * poiseuille_m_s  # blunter than Poiseuille's, so that the law shows
    vessel = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=LENGTH_MM, radius_mm=1e3 * RADIUS_M))))
    settings = FlowSettings(blood=BLOOD, inflow_mL_s=INFLOW_ML_S, numerics=Numerics(cell_size_mm=0.25, tolerance=0.005))
    field = simulate_case(vessel_case(vessel, settings))
    sign = np.sign(field.velocity_m_s[:, 2].mean())
    points = np.stack([1e3 * R_M[:700:50], 0 * R_M[:700:50], np.full(14, 7.0)], axis=1)
    found = sign * sampling.values_at(field, points)[0][:, 2]
    np.testing.assert_allclose(found, exact[:700:50], atol=0.015 * exact[0])
    ends = sampling.values_at(field, np.array([[0, 0, 4.0], [0, 0, 10.0]]))[1]
    assert -sign * np.diff(ends)[0] / 6e-3 == pytest.approx(gradient_Pa_m, rel=0.03)
    z = field.wall.vertices_mm[:, 2]
    stress_Pa = sign * field.wall_shear_stress_Pa[(z > 5) & (z < 9), 2].mean()
    assert stress_Pa == pytest.approx(0.5 * gradient_Pa_m * RADIUS_M, rel=0.03)


def test_a_pulses_mean_stress_is_the_mean_of_its_stresses() -> None:
    """Not that of the mean flow: thinning blood resists less when it flows faster. It goes one way: OSI is 0."""
    vessel = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=8.0, radius_mm=2.0), edge_mm=0.4)))
    waveform = Waveform(0.2, (0.9,), (0.0,))
    settings = FlowSettings(
        blood=BLOOD, inflow_mL_s=0.3, waveform=waveform, numerics=Numerics(cell_size_mm=0.4, max_cycles=2)
    )
    field = simulate_case(vessel_case(vessel, settings))
    middle = np.abs(field.wall.vertices_mm[:, 2] - 4.0) < 2.0
    stress_Pa = np.mean([phase.wall_shear_stress_Pa for phase in field.phases], axis=0)
    np.testing.assert_allclose(field.wall_shear_stress_Pa, stress_Pa, atol=1e-6)
    assert -1e-6 < field.oscillatory_shear_index[middle].min()
    grid = domain.build(vessel, 0.4)
    of_mean_Pa, _ = wall_stress(grid, field.velocity_m_s, field.pressure_Pa, lumen=field.wall, blood=BLOOD)
    ratio = np.linalg.norm(of_mean_Pa[middle], axis=1).mean() / np.linalg.norm(stress_Pa[middle], axis=1).mean()
    assert ratio > 1.01


def test_blood_in_a_screen_has_the_relaxation_time_of_its_shear_rate() -> None:
    """The rate is 1.5 / time of the stress, which is set: the time is that at which the law returns itself."""
    law = np.array([2.0, 4e4, 1.25, -0.624], np.float32)
    stress, time = 1e-3, np.float32(0.55)
    stride = 8
    f = np.zeros(19 * stride, np.float32)
    for q, (x, y, _) in enumerate(directions.VELOCITIES):  # momentum flux xy alone
        f[q * stride + 3] = 0.25 * stress * x * y
    found = d3q19.relaxation_times(f, stride, np.array([3, 5], np.int32), time, law)
    size = 2 * stress  # root of 2 n:n
    exact = brentq(lambda t: time + law[0] * (1 + (law[1] * 1.5 * size / t) ** law[2]) ** law[3] - t, 0.5, 3.0)
    assert found == pytest.approx([exact, time + law[0]], rel=1e-3)
    entry = np.array([[1.0, 0, 0, 0.3, 0.3, 0.1, 0.02]] * 2, np.float32)
    velocity = np.array([[0.002, 0.02, 0.0]] * 2, np.float32)
    through = d3q19.resisted(velocity, entry, found, np.float32(0.7))
    assert through[1, 1] < 0.99 * through[0, 1]  # thicker blood beside a sheet is braked more


def test_blood_without_thinning_has_one_viscosity_and_with_it_the_laws_limits() -> None:
    rates = np.array([0.0, 1e-3, 1e9])
    np.testing.assert_array_equal(Blood().viscosity_at_Pa_s(rates), 0.004)
    np.testing.assert_allclose(BLOOD.viscosity_at_Pa_s(rates), [0.056, 0.056, 0.00345], rtol=1e-3)
