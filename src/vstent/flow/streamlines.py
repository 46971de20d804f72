"""Streamlines of a flow field."""

from dataclasses import dataclass

import numpy as np

from vstent.flow import sampling
from vstent.flow.case import FlowField, Level
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel
from vstent.kernels import sampling as lattice_sampling
from vstent.kernels.arrays import Floats, Ints, freeze

STEP_CELLS = 0.4
"""Length of an integration step, in cells."""
LONGEST_MM = 150.0
"""Maximum length of a streamline in either direction, mm: ends lines caught in a vortex."""
SLOWEST_M_S = 1e-4
"""Minimum speed, m/s: a streamline ends where the blood is slower."""


@dataclass(frozen=True, eq=False)
class Streamlines:
    """Streamlines as polylines."""

    points_mm: Floats
    """(p, 3) points of all lines, one line after another."""
    starts: Ints
    """(s + 1,) index of the first point of every line, and p at the end."""
    speed_m_s: Floats
    """(p,) speed at every point."""

    def __post_init__(self) -> None:
        freeze(self, "points_mm", np.float64, (-1, 3))
        freeze(self, "starts", np.int32, (-1,))
        freeze(self, "speed_m_s", np.float64, (len(self.points_mm),))


def streamlines(field: FlowField, seeds_mm: Floats) -> Streamlines:
    """Trace streamlines through seeds (s, 3), upstream and downstream, to the vessel's openings.

    The method is fourth-order Runge-Kutta in arc length on trilinearly interpolated velocity. Seeds outside the blood
    give no line. Lines end at the openings, because the extensions beyond them are not part of the vessel.
    """
    grid, wall = sampling.uniform(field).finest, field.wall
    # Caps of the openings, widened to catch lines just outside the wall.
    vertices_mm = wall.caps.vertices_mm.copy()
    for loop, center_mm in zip(wall.boundary_loops, wall.loop_centers_mm, strict=True):
        outward_mm = vertices_mm[loop] - center_mm
        vertices_mm[loop] += grid.cell_size_mm * outward_mm / np.linalg.norm(outward_mm, axis=1, keepdims=True)
    mouths = Surface(vertices_mm, wall.caps.faces)
    up, down = (_one_way(grid, mouths, seeds_mm, step_cells) for step_cells in (-STEP_CELLS, STEP_CELLS))
    lines = [np.concatenate([back[:0:-1], ahead]) for back, ahead in zip(up, down, strict=True)]
    lines = [line for line in lines if len(line) > 2]
    starts = np.cumsum([0, *map(len, lines)])
    joined = np.concatenate(lines) if lines else np.zeros((0, 4))
    return Streamlines(joined[:, :3], starts, joined[:, 3])


def _one_way(grid: Level, mouths: Surface, seeds_mm: Floats, step_cells: float) -> list[Floats]:
    """Return points in mm and speed (p, 4) from every seed (s, 3) in one direction, until they leave by a mouth."""
    seeds = np.ascontiguousarray(grid.places(seeds_mm))
    most = int(LONGEST_MM / grid.cell_size_mm / STEP_CELLS)
    paths, count = lattice_sampling.trace_all(grid.index, grid.velocity_m_s, seeds, step_cells, SLOWEST_M_S, most)
    paths[..., :3] = grid.origin_mm + paths[..., :3] * grid.cell_size_mm
    lines = []
    for whole, n in zip(paths, count, strict=True):
        path = whole[:n]
        step_mm = np.diff(path[:, :3], axis=0)
        length_mm = np.linalg.norm(step_mm, axis=1)
        ahead = step_mm / np.maximum(length_mm, 1e-12)[:, None]
        distance_mm, face = mouths.first_hits(path[:-1, :3], ahead)
        leaves = (distance_mm <= length_mm) & (np.einsum("ij,ij->i", mouths.normals[face], ahead) > 0)
        lines.append(path[: int(np.argmax(leaves)) + 1] if leaves.any() else path)
    return lines


def inlet_seeds_mm(field: FlowField, vessel: Vessel, count: int) -> Floats:
    """Return about `count` cell centres (s, 3) evenly drawn from the sections of all inlets."""
    near = np.zeros(len(field.centers_mm), dtype=bool)
    for inlet in vessel.inlets:
        offset = field.centers_mm - inlet.center_mm
        along = offset @ inlet.normal
        near |= (np.abs(along + field.sizes_mm) < 0.5 * field.sizes_mm) & (
            np.linalg.norm(offset, axis=1) < inlet.diameter_mm
        )
    return _drawn(field.centers_mm[near], count)


def neck_seeds_mm(field: FlowField, neck: Surface, count: int) -> Floats:
    """Return about `count` points (s, 3) evenly drawn from the neck."""
    return _drawn(sampling.surface_samples(neck, field.finest.cell_size_mm)[0], count)


def _drawn(points: Floats, count: int) -> Floats:
    """Return about `count` of the points at equal intervals of their order."""
    return points[np.unique(np.linspace(0, max(len(points) - 1, 0), min(count, len(points))).round().astype(int))]
