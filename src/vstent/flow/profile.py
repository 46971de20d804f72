"""Laminar velocity profiles in a section of any shape: fully developed, plug and pulsating (Womersley)."""

from typing import Final

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve
from scipy.special import jv

from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Complex, Floats
from vstent.units import M_PER_MM

POINTS: Final = 64
"""Number of grid points across a section."""


def plug_profile(section_mm: Floats, normal: Floats, points_mm: Floats) -> Floats:
    """Return the axial speed over its mean (n,) of a uniform flow in a flat section (k, 3), at points (n, 3)."""
    across = _across(normal)
    depth = distance_inside((section_mm - section_mm[0]) @ across, (points_mm - section_mm[0]) @ across)
    return np.where(depth > 0, 1.0, 0.0)


def developed_profile(section_mm: Floats, normal: Floats, points_mm: Floats) -> Floats:
    """Return the axial speed over its mean (n,) of fully developed flow in a flat section (k, 3), at points (n, 3).

    Laminar flow along a straight tube with this section: lap u = -1 with u = 0 on the polygon, solved with five-point
    differences (White 2006, Viscous Fluid Flow, eq. 3-30). The result is interpolated linearly between grid points and
    zero outside.
    """
    return _developed(section_mm, normal, points_mm)[0]


def pulsating_profiles(
    section_mm: Floats, normal: Floats, points_mm: Floats, rate_per_s: Floats, viscosity_m2_s: float
) -> Complex:
    """Return the axial speed over its mean (h, n) of flows that oscillate with frequencies (h,), at points (n, 3).

    In a round section they are exact. Another section is that of the circle of its area at the radius where the
    developed flow is as far below its maximum; the mean over the section is then 1.

    References
    ----------
    Womersley 1955, J. Physiol. 127, 553.
    """
    speed, inside = _developed(section_mm, normal, points_mm)
    radius_m = np.sqrt(abs(triangles.polygon_area_vector(section_mm) @ normal) / np.pi) * M_PER_MM
    number = radius_m * np.sqrt(rate_per_s[:, None] / viscosity_m2_s) * 1j**1.5

    def unscaled(of_speed: Floats) -> Complex:
        outward = np.sqrt(np.clip(1 - of_speed / inside.max(), 0.0, 1.0))
        return np.asarray(1 - jv(0, number * outward) / jv(0, number))

    return np.asarray(unscaled(speed) / unscaled(inside).mean(axis=1, keepdims=True))


def _across(normal: Floats) -> Floats:
    """Return two axes (3, 2) across a normal."""
    first = curves.any_perpendicular(normal)
    return np.stack([first, np.cross(normal, first)], axis=1)


def _developed(section_mm: Floats, normal: Floats, points_mm: Floats) -> tuple[Floats, Floats]:
    """Return the speed over its mean of `developed_profile` at points (n,), and at grid points of the section (m,)."""
    center = section_mm.mean(axis=0)
    across = _across(normal)
    polygon = (section_mm - center) @ across
    grid, spacing = grid_over(polygon)
    low = grid[0, 0]
    depth = distance_inside(polygon, grid)
    speed = _poisson(depth / spacing)
    inside = speed[depth > 0] / speed[depth > 0].mean()
    speed = _beyond(speed / speed[depth > 0].mean(), depth)
    where = ((points_mm - center) @ across - low) / spacing
    return np.maximum(ndimage.map_coordinates(speed, where.T, order=1, mode="constant"), 0.0), inside


def grid_over(polygon: Floats) -> tuple[Floats, float]:
    """Return grid points (i, j, 2) over a polygon (k, 2) and their spacing, with a margin of two points."""
    spacing = float(np.ptp(polygon, axis=0).max()) / POINTS
    low = polygon.min(axis=0) - 2.01 * spacing
    shape = np.ceil(np.ptp(polygon, axis=0) / spacing).astype(int) + 5
    return low + spacing * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1), spacing


def distance_inside(polygon: Floats, points: Floats) -> Floats:
    """Return the distance (...) of points (..., 2) from a polygon (k, 2), negative outside.

    Points inside have an odd number of edges to their right.
    """
    nearest, inside = np.full(points.shape[:-1], np.inf), np.zeros(points.shape[:-1], dtype=bool)
    x, y = points[..., 0], points[..., 1]
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        along = np.clip((points - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-300), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(points - a - along[..., None] * (b - a), axis=-1))
        if a[1] != b[1]:
            inside ^= ((a[1] > y) != (b[1] > y)) & (x < a[0] + (y - a[1]) * (b[0] - a[0]) / (b[1] - a[1]))
    return np.where(inside, nearest, -nearest)


_NEIGHBOURS: Final = ((1, 0), (-1, 0), (0, 1), (0, -1))
"""Steps to the four neighbours of a grid point."""


def _poisson(depth: Floats) -> Floats:
    """Return the solution of lap u = -1 in grid units, with u = 0 on the boundary and outside.

    `depth` is the distance to the boundary, positive inside. The boundary is resolved between grid points to second
    order (Gibou et al. 2002, J. Comput. Phys. 176, 205).
    """
    inside = depth > 0
    number = np.full(inside.shape, -1)
    count = int(inside.sum())
    number[inside] = np.arange(count)
    place = np.argwhere(inside)
    diagonal = np.zeros(count)
    links = sparse.csr_matrix((count, count))
    for offset in _NEIGHBOURS:
        beside = tuple((place + offset).T)
        has = np.flatnonzero(number[beside] >= 0)
        links = links + sparse.csr_matrix((np.ones(len(has)), (has, number[beside][has])), shape=(count, count))
        part = depth[inside] / (depth[inside] - np.minimum(depth[beside], 0.0))
        diagonal += np.where(number[beside] >= 0, 1.0, 1 / np.maximum(part, 1e-3))
    speed = np.zeros(inside.shape)
    speed[inside] = spsolve((sparse.diags(diagonal) - links).tocsc(), np.ones(count))
    return speed


def _beyond(speed: Floats, depth: Floats) -> Floats:
    """Return the speed extrapolated to the points just outside, so that interpolation gives 0 on the boundary."""
    result = speed.copy()
    outside = depth <= 0
    total, count = np.zeros(speed.shape), np.zeros(speed.shape)
    for offset in _NEIGHBOURS:
        u, d = np.roll(speed, offset, axis=(0, 1)), np.roll(depth, offset, axis=(0, 1))
        is_edge = outside & (d > 0)
        total[is_edge] += (u * depth)[is_edge] / np.maximum(d, -0.5 * depth)[is_edge]
        count[is_edge] += 1
    result[count > 0] = total[count > 0] / count[count > 0]
    return result
