"""From OpenFOAM's cells and faces to the grid, the ostium and the wall that every result of vstent lies on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.sparse import csr_matrix

from vstent.flow import sampling
from vstent.flow.case import FlowCase
from vstent.flow.domain import Domain
from vstent.flow.openfoam import folder as folders
from vstent.flow.openfoam import results, scatter
from vstent.flow.openfoam.mesh import STRUTS
from vstent.kernels.arrays import Floats
from vstent.units import M_PER_MM

OSTIUM_SPACING: Final = 0.5
"""Spacing of points on the ostium, in cells. Between wires finer ones lie: at 1 Silk's neck inflow in the demo is 0.7 %
off, at 0.5 it is 0.02 %."""


@dataclass(frozen=True, eq=False)
class Bridge:
    """Sparse matrices; the velocity's sources are the cells and then the faces of the patches that hold theirs."""

    to_cells: csr_matrix
    """(n, s) velocity -> grid cells."""
    pressure_to_cells: csr_matrix
    """(n, c) cells -> grid cells."""
    to_ostium: csr_matrix
    """(o, s) velocity -> points on the ostium."""
    ostium_area_mm2: Floats
    """(o, 3) area vectors of these points."""
    wall_to_lumen: csr_matrix
    """(v, f) faces of the walls -> vertices of the lumen."""
    pressure_to_lumen: csr_matrix
    """(v, c) cells -> vertices of the lumen."""
    walls: dict[str, int]
    """Faces of every patch that is wall, in the order of the sources."""
    n_cells: int
    """Cells of OpenFOAM's mesh."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A moment of the flow, in SI units."""

    time: str
    """Its name: iterations, or seconds."""
    velocity_m_s: Floats
    """(n, 3) in the grid's cells."""
    pressure_Pa: Floats
    """(n,) in the grid's cells."""
    wall_shear_stress_Pa: Floats
    """(v, 3) at the lumen's vertices."""
    wall_pressure_Pa: Floats
    """(v,) at the lumen's vertices."""
    outflow_mL_s: Floats
    """(k,) through every opening."""
    neck_inflow_mL_s: float
    """Into the sac; 0 where there is none."""


def bridge(case: FlowCase, domain: Domain, folder: Path) -> Bridge:
    """Build the matrices for a meshed case.

    Raises
    ------
    ReadError
        When the cells' centres are missing or damaged.
    """
    centers = results.read_field(folder, "0", "C")
    inside_mm = centers.inside / M_PER_MM
    at_rest = {name: centers.patches[name] / M_PER_MM for name in ("wall", "sac", STRUTS) if name in centers.patches}
    at_inlets_mm = [centers.patches[inlet.role] / M_PER_MM for inlet in case.vessel.inlets]
    known_mm = np.concatenate([inside_mm, *at_rest.values(), *at_inlets_mm])
    ostium_mm, area_mm2 = np.zeros((0, 3)), np.zeros((0, 3))
    if case.ostium is not None:
        ostium_mm, area_mm2 = sampling.surface_samples(case.ostium, OSTIUM_SPACING * domain.cell_size_mm)
    lumen = case.vessel.lumen
    return Bridge(
        scatter.fits(known_mm, domain.centers_mm),
        scatter.fits(inside_mm, domain.centers_mm),
        scatter.fits(known_mm, ostium_mm),
        area_mm2,
        _wall_to_lumen(case, np.concatenate(list(at_rest.values())), 2 * domain.cell_size_mm),
        scatter.fits(inside_mm, lumen.vertices_mm),
        {name: len(faces) for name, faces in at_rest.items()},
        len(inside_mm),
    )


def _wall_to_lumen(case: FlowCase, faces_mm: Floats, reach_mm: float) -> csr_matrix:
    """Means of the faces near a vertex; those of a wall back to back with it are far off by their normals."""
    lumen = case.vessel.lumen
    facing = lumen.normals[lumen.closest(faces_mm)[2]]
    sources = np.hstack([faces_mm, reach_mm * facing])
    return scatter.near_means(sources, np.hstack([lumen.vertices_mm, reach_mm * lumen.vertex_normals]), reach_mm)


def read(case: FlowCase, across: Bridge, folder: Path, time: str) -> Snapshot:
    """Read a time of a case.

    Raises
    ------
    ReadError
        When a field is missing or damaged.
    """
    density = case.blood.density_kg_m3
    velocity = results.read_field(folder, time, "U")
    at_rest = np.zeros((sum(across.walls.values()), 3))
    known = np.concatenate([velocity.inside, at_rest, *_at_inlets(case, velocity, float(time))])
    pressure_Pa = density * results.read_field(folder, time, "p").inside[:, 0]
    stress = results.read_field(folder, time, "wallShearStress").patches
    # OpenFOAM's is what the wall does to the blood, over density.
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


def _at_inlets(case: FlowCase, velocity: results.VolumeField, time: float) -> list[Floats]:
    """Velocity (f, 3) on every inlet's faces: a pulse is written as what its factor multiplies."""
    factor = float(case.settings.inflow_factor(np.array([time]))[0])
    multiples = {name: factor * values for name, values in velocity.references.items()}
    return [(multiples | velocity.patches)[inlet.role] for inlet in case.vessel.inlets]
