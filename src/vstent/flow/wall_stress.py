"""Wall shear stress and pressure on the lumen, computed from the cells near the wall."""

import numpy as np

from vstent.flow.domain import Domain
from vstent.flow.settings import Blood
from vstent.geometry.surface import Surface
from vstent.kernels import sampling
from vstent.kernels.arrays import Floats
from vstent.units import M_PER_MM

REACH = 4
"""Radius of the neighbourhood of a wall point, in cells."""


def wall_stress(
    domain: Domain, velocity_m_s: Floats, pressure_Pa: Floats, *, lumen: Surface, blood: Blood
) -> tuple[Floats, Floats]:
    """Compute wall shear stress (v, 3) and pressure (v,) at the vertices of the lumen, both in Pa.

    The stress is the tangential traction mu du/dn of the blood on the wall. It comes from a least-squares fit that is
    exact for Poiseuille flow (see `sampling.fit_wall`).
    """
    gradient_per_s, wall_pressure_Pa = _fit(domain, velocity_m_s, pressure_Pa, lumen)
    shear_per_s = _along(gradient_per_s, lumen)
    viscosity_Pa_s = blood.viscosity_at_Pa_s(np.linalg.norm(shear_per_s, axis=1))
    return viscosity_Pa_s[:, None] * shear_per_s, wall_pressure_Pa


def mean_shear_Pa(domain: Domain, velocity_m_s: Floats, speed_m_s: Floats, *, lumen: Surface, blood: Blood) -> Floats:
    """Compute the mean magnitude (v,) of the wall shear stress from mean velocity (n, 3) and mean speed (n,) over time.

    Near a wall, speed is shear rate times distance at every moment. The excess of the mean speed over the magnitude of
    the mean velocity therefore gives the excess of the mean shear rate over that of the mean flow. The gradient of the
    mean speed alone would overestimate the stress where the flow direction rotates, because there velocities cancel and
    speeds do not.
    """
    no_pressure_Pa = np.zeros(len(speed_m_s))
    shear_per_s = _along(_fit(domain, velocity_m_s, no_pressure_Pa, lumen)[0], lumen)
    beyond_m_s = speed_m_s - np.linalg.norm(velocity_m_s, axis=1)
    beyond_per_s = _fit(domain, beyond_m_s[:, None] * np.eye(3)[0], no_pressure_Pa, lumen)[0][:, 0]
    rate_per_s = np.linalg.norm(shear_per_s, axis=1) + np.maximum(beyond_per_s, 0.0)
    return blood.viscosity_at_Pa_s(rate_per_s) * rate_per_s


def _along(gradient_per_s: Floats, lumen: Surface) -> Floats:
    """Return the part along the wall of vectors (v, 3) at the lumen's vertices."""
    normal = lumen.vertex_normals
    return gradient_per_s - np.einsum("ij,ij->i", gradient_per_s, normal)[:, None] * normal


def _fit(domain: Domain, velocity_m_s: Floats, pressure_Pa: Floats, lumen: Surface) -> tuple[Floats, Floats]:
    """Return the wall-normal velocity gradient (v, 3), 1/s, and the pressure (v,) at the lumen's vertices."""
    fit = sampling.fit_wall(
        domain.index,
        domain.depth_mm / domain.cell_size_mm,
        velocity_m_s,
        pressure_Pa,
        domain.places(lumen.vertices_mm),
        -lumen.vertex_normals,
        REACH,
    )
    return fit[:, :3] / (domain.cell_size_mm * M_PER_MM), fit[:, 3]
