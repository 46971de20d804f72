"""Blood that thins with the shear rate, in a pipe, against the integral of its law."""

import numpy as np
import pytest
from scipy.optimize import brentq

from vstent import phantoms
from vstent.flow import Blood, FlowCase, FlowSettings, sampling, simulate_case
from vstent.flow.types import CarreauYasuda
from vstent.trace import trace
from vstent.vessel import Vessel

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
    settings = FlowSettings(blood=BLOOD, inflow_mL_s=INFLOW_ML_S, cell_size_mm=0.25, tolerance=0.005)
    field = simulate_case(FlowCase(vessel, settings=settings))
    sign = np.sign(field.velocity_m_s[:, 2].mean())
    points = np.stack([1e3 * R_M[:700:50], 0 * R_M[:700:50], np.full(14, 7.0)], axis=1)
    found = sign * sampling.values_at(field, points)[0][:, 2]
    np.testing.assert_allclose(found, exact[:700:50], atol=0.015 * exact[0])
    ends = sampling.values_at(field, np.array([[0, 0, 4.0], [0, 0, 10.0]]))[1]
    assert -sign * np.diff(ends)[0] / 6e-3 == pytest.approx(gradient_Pa_m, rel=0.03)
    z = field.wall.vertices_mm[:, 2]
    stress_Pa = sign * field.wall_shear_stress_Pa[(z > 5) & (z < 9), 2].mean()
    assert stress_Pa == pytest.approx(0.5 * gradient_Pa_m * RADIUS_M, rel=0.03)


def test_blood_without_thinning_has_one_viscosity_and_with_it_the_laws_limits() -> None:
    rates = np.array([0.0, 1e-3, 1e9])
    np.testing.assert_array_equal(Blood().viscosity_at_Pa_s(rates), 0.004)
    np.testing.assert_allclose(BLOOD.viscosity_at_Pa_s(rates), [0.056, 0.056, 0.00345], rtol=1e-3)
