"""Transfer of OpenFOAM's fields from its mesh to the regular grid, the ostium and the lumen."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.sparse import csr_matrix

from vstent.flow import sampling
from vstent.flow.case import FlowCase
from vstent.flow.domain import Domain
from vstent.flow.openfoam import folder as folders, results, scatter
from vstent.flow.openfoam.mesh import STRUTS
from vstent.kernels.arrays import Floats
from vstent.units import M_PER_MM

OSTIUM_SPACING: Final = 0.5
"""Spacing of sample points on the ostium, in grid cells. The mesh is finer between wires: the neck inflow of the
demo with Silk is off by 0.7 % at a spacing of 1 and by 0.02 % at 0.5."""


@dataclass(frozen=True, eq=False)
class Bridge:
    """Sparse interpolation matrices from OpenFOAM's mesh.

    The sources (s) of velocity are the cells, followed by the faces of the patches with known velocity.
    """

    to_cells: csr_matrix
    """(n, s) velocity to the cells of the grid."""
    pressure_to_cells: csr_matrix
    """(n, c) cell values to the cells of the grid."""
    to_ostium: csr_matrix
    """(o, s) velocity to sample points on the ostium."""
    ostium_area_mm2: Floats
    """(o, 3) area vectors of these points."""
    wall_to_lumen: csr_matrix
    """(v, f) values on the wall's faces to the vertices of the lumen."""
    pressure_to_lumen: csr_matrix
    """(v, c) cell values to the vertices of the lumen."""
    walls: dict[str, int]
    """Number of faces of every wall patch, in the order of the sources."""
    n_cells: int
    """Number of cells in OpenFOAM's mesh."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The flow at one time, in SI units."""

    time: str
    """Name of the time: a number of iterations, or seconds."""
    velocity_m_s: Floats
    """(n, 3) velocity in the cells of the grid."""
    pressure_Pa: Floats
    """(n,) pressure in the cells of the grid."""
    wall_shear_stress_Pa: Floats
    """(v, 3) wall shear stress at the lumen's vertices."""
    wall_pressure_Pa: Floats
    """(v,) pressure at the lumen's vertices."""
    outflow_mL_s: Floats
    """(k,) flow rate out through every opening."""
    neck_inflow_mL_s: float
    """Neck inflow; 0 without a sac."""


def bridge(case: FlowCase, domain: Domain, folder: Path) -> Bridge:
    """Build the interpolation matrices of a meshed case."""
    centers = results.read_field(folder, "0", "C")
    inside_mm = centers.inside / M_PER_MM
    at_rest = {name: centers.patches[name] / M_PER_MM for name in ("wall", "sac", STRUTS) if name in centers.patches}
    at_inlets_mm = [centers.patches[inlet.role] / M_PER_MM for inlet in case.vessel.inlets]
    known_mm = np.concatenate([inside_mm, *at_rest.values(), *at_inlets_mm])
    ostium_mm, area_mm2 = np.zeros((0, 3)), np.zeros((0, 3))
    if case.ostium is not None:
        ostium_mm, area_mm2 = sampling.surface_samples(case.ostium, OSTIUM_SPACING * domain.cell_size_mm)
    lumen, reach_mm = case.vessel.lumen, 2 * domain.cell_size_mm
    wall_mm = np.concatenate(list(at_rest.values()))
    # Positions with normals, so that a vertex has no part of a wall back to back with its own.
    facing = np.hstack([wall_mm, reach_mm * lumen.normals[lumen.closest(wall_mm)[2]]])
    return Bridge(
        scatter.fits(known_mm, domain.centers_mm),
        scatter.fits(inside_mm, domain.centers_mm),
        scatter.fits(known_mm, ostium_mm),
        area_mm2,
        scatter.near_means(facing, np.hstack([lumen.vertices_mm, reach_mm * lumen.vertex_normals]), reach_mm),
        scatter.fits(inside_mm, lumen.vertices_mm),
        {name: len(faces) for name, faces in at_rest.items()},
        len(inside_mm),
    )


def read(case: FlowCase, across: Bridge, folder: Path, time: str) -> Snapshot:
    """Read the flow at one time of a case."""
    density = case.blood.density_kg_m3
    velocity = results.read_field(folder, time, "U")
    # With a waveform, OpenFOAM's files hold the velocity at inlets divided by the waveform's factor.
    factor = float(case.inflow_factor(np.array([float(time)]))[0])
    at_inlets = {name: factor * values for name, values in velocity.references.items()} | velocity.patches
    at_rest = np.zeros((sum(across.walls.values()), 3))
    known = np.concatenate([velocity.inside, at_rest, *(at_inlets[inlet.role] for inlet in case.vessel.inlets)])
    pressure_Pa = density * results.read_field(folder, time, "p").inside[:, 0]
    stress = results.read_field(folder, time, "wallShearStress").patches
    # OpenFOAM writes the traction of the wall on the blood, divided by the density.
    traction_Pa = across.wall_to_lumen @ (-density * np.concatenate([stress[name] for name in across.walls]))
    normal = case.vessel.lumen.vertex_normals
    through_mL_s = sampling.through_mL_s(across.to_ostium @ known, across.ostium_area_mm2)
    return Snapshot(
        time,
        across.to_cells @ known,
        across.pressure_to_cells @ pressure_Pa,
        traction_Pa - np.einsum("ij,ij->i", traction_Pa, normal)[:, None] * normal,
        across.pressure_to_lumen @ pressure_Pa,
        np.array([folders.flow_mL_s(folder, opening.role, time) for opening in case.vessel.openings]),
        sampling.inflow_mL_s(through_mL_s),
    )
