"""Streamlines of a flow field."""

from dataclasses import dataclass

import numpy as np

from vstent.flow import sampling
from vstent.flow.case import FlowField
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel
from vstent.kernels import sampling as lattice_sampling
from vstent.kernels.arrays import Floats, Ints, freeze

STEP_CELLS = 0.4
"""Length of a step, in cells."""
LONGEST_MM = 150.0
"""A line caught in a vortex ends here."""
SLOWEST_M_S = 1e-4
"""A line ends where blood stands."""


@dataclass(frozen=True, eq=False)
class Streamlines:
    """Polylines along the flow."""

    points_mm: Floats
    """(p, 3) one line after another."""
    starts: Ints
    """(s + 1,) first point of every line, and p at the end."""
    speed_m_s: Floats
    """(p,) speed at every point."""

    def __post_init__(self) -> None:
        freeze(self, "points_mm", np.float64, (-1, 3))
        freeze(self, "starts", np.int32, (-1,))
        freeze(self, "speed_m_s", np.float64, (len(self.points_mm),))


def streamlines(field: FlowField, seeds_mm: Floats) -> Streamlines:
    """Trace the flow through every seed (s, 3), upstream and downstream, to the vessel's openings.

    Fourth-order Runge-Kutta in arc length on trilinear velocity; seeds outside the blood give no line. What blood does
    in the extensions beyond the openings is no part of the vessel.
    """
    mouths = _mouths(field.wall, field.cell_size_mm)
    up, down = (_ways(field, mouths, seeds_mm, step_cells) for step_cells in (-STEP_CELLS, STEP_CELLS))
    lines = [np.concatenate([back[:0:-1], ahead]) for back, ahead in zip(up, down, strict=True)]
    lines = [line for line in lines if len(line) > 2]
    starts = np.cumsum([0, *map(len, lines)])
    joined = np.concatenate(lines) if lines else np.zeros((0, 4))
    return Streamlines(joined[:, :3], starts, joined[:, 3])


def _ways(field: FlowField, mouths: Surface, seeds_mm: Floats, step_cells: float) -> list[Floats]:
    """Points in mm and speed (p, 4) from every seed (s, 3) on, as far as the blood stays in the vessel."""
    seeds = np.ascontiguousarray((seeds_mm - field.origin_mm) / field.cell_size_mm)
    most = int(LONGEST_MM / field.cell_size_mm / STEP_CELLS)
    path, count = lattice_sampling.trace_all(field.index, field.velocity_m_s, seeds, step_cells, SLOWEST_M_S, most)
    path[..., :3] = field.origin_mm + path[..., :3] * field.cell_size_mm
    return [_within(mouths, points[:n]) for points, n in zip(path, count, strict=True)]


def _mouths(wall: Surface, beyond_mm: float) -> Surface:
    """What closes a vessel's openings, wider by as much as blood between cells may move outside the wall."""
    vertices_mm = wall.caps.vertices_mm.copy()
    for loop, center_mm in zip(wall.boundary_loops, wall.loop_centers_mm, strict=True):
        outward_mm = vertices_mm[loop] - center_mm
        vertices_mm[loop] += beyond_mm * outward_mm / np.linalg.norm(outward_mm, axis=1, keepdims=True)
    return Surface(vertices_mm, wall.caps.faces)


def _within(mouths: Surface, way: Floats) -> Floats:
    """A way (p, 4) as far as the last point before it leaves through an opening, for the first time."""
    step_mm = np.diff(way[:, :3], axis=0)
    length_mm = np.linalg.norm(step_mm, axis=1)
    ahead = step_mm / np.maximum(length_mm, 1e-12)[:, None]
    distance_mm, face = mouths.first_hits(way[:-1, :3], ahead)
    leaves = (distance_mm <= length_mm) & (np.einsum("ij,ij->i", mouths.normals[face], ahead) > 0)
    return way[: int(np.argmax(leaves)) + 1] if leaves.any() else way


def inlet_seeds_mm(field: FlowField, vessel: Vessel, count: int) -> Floats:
    """About `count` cell centres (s, 3), evenly drawn from the sections of all inlets."""
    near = np.zeros(len(field.cells), dtype=bool)
    for inlet in vessel.inlets:
        offset = field.centers_mm - inlet.center_mm
        along = offset @ inlet.normal
        near |= (np.abs(along + field.cell_size_mm) < 0.5 * field.cell_size_mm) & (
            np.linalg.norm(offset, axis=1) < inlet.diameter_mm
        )
    return _drawn(field.centers_mm[near], count)


def neck_seeds_mm(field: FlowField, neck: Surface, count: int) -> Floats:
    """About `count` points (s, 3), evenly drawn from the neck."""
    return _drawn(sampling.surface_samples(neck, field.cell_size_mm)[0], count)


def _drawn(points: Floats, count: int) -> Floats:
    return points[np.unique(np.linspace(0, max(len(points) - 1, 0), min(count, len(points))).round().astype(int))]
