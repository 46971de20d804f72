"""A field between its cells, and surfaces as sample points."""

import numpy as np

from vstent.flow.case import FlowField
from vstent.geometry.surface import Surface
from vstent.kernels import sampling as lattice_sampling
from vstent.kernels import voxels
from vstent.kernels.arrays import Floats, Ints


def values_at(field: FlowField, points_mm: Floats) -> tuple[Floats, Floats]:
    """Velocity (m, 3) in m/s, zero outside, and pressure (m,) in Pa at points (m, 3)."""
    points = (points_mm - field.origin_mm) / field.cell_size_mm
    velocity = lattice_sampling.interpolate(field.index, field.velocity_m_s, points, True)
    pressure = lattice_sampling.interpolate(field.index, field.pressure_Pa[:, None], points, False)[:, 0]
    return velocity, pressure


def speed_at(field: FlowField, points_mm: Floats) -> Floats:
    """Speed (m,) in m/s at points (m, 3), its mean where a steady flow moves; zero outside."""
    points = (points_mm - field.origin_mm) / field.cell_size_mm
    return lattice_sampling.interpolate(field.index, field.speed_m_s[:, None], points, True)[:, 0]


def surface_samples(surface: Surface, spacing_mm: float) -> tuple[Floats, Floats]:
    """Points (p, 3) at most about `spacing_mm` apart on a surface and their area vectors (p, 3) in mm^2."""
    done, corners = [], surface.corners_mm
    while len(corners):
        is_long = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1) > spacing_mm
        done.append(corners[~is_long])
        corners = _quartered(corners[is_long])
    corners = np.concatenate(done) if done else corners
    area_mm2 = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return corners.mean(axis=1), area_mm2


def _quartered(corners: Floats) -> Floats:
    """Triangles (m, 3, 3) cut at the middles of their edges: (4 m, 3, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    return np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])


def through_mL_s(velocity_m_s: Floats, area_mm2: Floats) -> Floats:
    """Flow (p,) through sample points with velocities (p, 3) and area vectors (p, 3)."""
    return np.einsum("ij,ij->i", velocity_m_s, area_mm2)  # m/s times mm2 is mL/s


def read_through_mL_s(index: Ints, velocity_m_s: Floats, points: Floats, area_mm2: Floats) -> Floats:
    """Flow (p,) through points (p, 3), in grid units, with area vectors (p, 3), of velocities (n, 3) of cells.

    Read by Lagrange's cubics of the 64 cells around: a chord lies below the peak of a jet, a bare neck's by 1 to 2 %.
    """
    return through_mL_s(lattice_sampling.interpolate_cubic(index, velocity_m_s, points), area_mm2)


def inflow_mL_s(through_mL_s: Floats) -> float:
    """Sum of what goes through sample points (p,) the way of their area vectors; what comes back is left out."""
    return float(np.maximum(through_mL_s, 0.0).sum())


def cells_inside(surface: Surface, centers_mm: Floats, cell_size_mm: float) -> Ints:
    """Numbers of the cell centres (n, 3) that lie inside a closed surface."""
    low = surface.vertices_mm.min(axis=0) - cell_size_mm
    near = np.flatnonzero(
        ((centers_mm >= low) & (centers_mm <= surface.vertices_mm.max(axis=0) + cell_size_mm)).all(axis=1)
    )
    if len(near) == 0:
        return near.astype(np.int32)
    origin_mm = centers_mm[near].min(axis=0) - cell_size_mm
    place = np.rint((centers_mm[near] - origin_mm) / cell_size_mm).astype(int)
    shape = place.max(axis=0) + 2
    inside = voxels.fill((surface.corners_mm - origin_mm) / cell_size_mm, (int(shape[0]), int(shape[1]), int(shape[2])))
    return near[inside[tuple(place.T)]].astype(np.int32)
