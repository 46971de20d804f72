"""Wall shear stress and pressure on the lumen, from the cells near the wall."""

import numpy as np

from vstent.flow.domain import Domain
from vstent.flow.types import Blood
from vstent.kernels import lattice_sampling
from vstent.kernels.arrays import Floats
from vstent.surface import Surface
from vstent.units import M_PER_MM

REACH = 5
"""Radius of the neighbourhood of a wall point, in cells."""


def wall_stress(
    domain: Domain, velocity_m_s: Floats, pressure_Pa: Floats, *, lumen: Surface, blood: Blood
) -> tuple[Floats, Floats]:
    """Wall shear stress (v, 3) in Pa and pressure (v,) in Pa at the vertices of the lumen.

    The stress is the traction along the wall, mu du/dn, from a least-squares fit that is exact for Poiseuille flow (see
    `lattice_sampling.fit_wall`); it points the way the blood drags the wall.

    Parameters
    ----------
    domain : the cells, and how far they are from the wall.
    velocity_m_s, pressure_Pa : (n, 3), (n,) of the cells.
    lumen : the wall, open at its ends; its faces are outward.
    """
    fit = lattice_sampling.fit_wall(
        domain.index,
        domain.depth_mm / domain.cell_size_mm,
        velocity_m_s,
        pressure_Pa,
        (lumen.vertices_mm - domain.origin_mm) / domain.cell_size_mm,
        -lumen.vertex_normals,
        REACH,
    )
    gradient_per_s = fit[:, :3] / (domain.cell_size_mm * M_PER_MM)
    normal = lumen.vertex_normals
    shear_per_s = gradient_per_s - np.einsum("ij,ij->i", gradient_per_s, normal)[:, None] * normal
    viscosity_Pa_s = blood.viscosity_at_Pa_s(np.linalg.norm(shear_per_s, axis=1))
    return viscosity_Pa_s[:, None] * shear_per_s, fit[:, 3]
