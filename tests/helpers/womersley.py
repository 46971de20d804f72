"""Womersley's flow in a tube: a mean parabola and one harmonic."""

import numpy as np
from scipy.special import jv

from vstent.flow.settings import Waveform

RADIUS_M, MEAN_MEAN_M_S, SWING = 2e-3, 0.03, 0.8
VISCOSITY_PA_S, DENSITY_KG_M3 = 0.004, 1060.0
PULSE = Waveform(0.951, (SWING,), (0.0,))
OMEGA = 2 * np.pi / PULSE.period_s
BETA = RADIUS_M * np.sqrt(OMEGA * DENSITY_KG_M3 / VISCOSITY_PA_S) * 1j**1.5
SHAPE = 1 - 2 * jv(1, BETA) / (BETA * jv(0, BETA))


def womersley_m_s(r_m: np.ndarray, time_s: float) -> np.ndarray:
    """Womersley 1955 (J. Physiol. 127, 553) for a given flow: mean parabola and one harmonic."""
    swinging = (1 - jv(0, BETA * r_m / RADIUS_M) / jv(0, BETA)) / SHAPE * np.exp(1j * OMEGA * time_s)
    return MEAN_MEAN_M_S * (2 * (1 - (r_m / RADIUS_M) ** 2) + SWING * swinging.real)


def womersley_wss_Pa() -> tuple[float, complex]:
    """Mean and complex amplitude of the wall shear stress."""
    slope = BETA / RADIUS_M * jv(1, BETA) / jv(0, BETA) / SHAPE
    return VISCOSITY_PA_S * MEAN_MEAN_M_S * 4 / RADIUS_M, -VISCOSITY_PA_S * MEAN_MEAN_M_S * SWING * slope
