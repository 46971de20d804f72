"""Fully developed laminar profile on a section of any shape."""

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve

from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats

POINTS = 64
"""Grid points across a section."""


def developed_profile(section_mm: Floats, normal: Floats, points_mm: Floats) -> Floats:
    """Axial speed (n,), in an arbitrary unit, at points (n, 3) of fully developed flow through a flat section (k, 3).

    Laminar flow along a straight tube with this section: lap u = -1 with u = 0 on the polygon (White 2006, Viscous
    Fluid Flow, eq. 3-30), by five-point differences, linear between the grid points and zero outside.
    """
    center = section_mm.mean(axis=0)
    first = curves.any_perpendicular(normal)
    across = np.stack([first, np.cross(normal, first)], axis=1)
    polygon = (section_mm - center) @ across
    spacing = float(np.ptp(polygon, axis=0).max()) / POINTS
    low = polygon.min(axis=0) - 2.01 * spacing
    shape = np.ceil(np.ptp(polygon, axis=0) / spacing).astype(int) + 5
    grid = low + spacing * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    speed = _poisson(_inside(polygon, grid))
    where = ((points_mm - center) @ across - low) / spacing
    return ndimage.map_coordinates(speed, where.T, order=1, mode="constant")


def _inside(polygon: Floats, points: Floats) -> Bools:
    """Tell which points (..., 2) lie inside a polygon (k, 2): an odd number of edges to the right."""
    result = np.zeros(points.shape[:-1], dtype=bool)
    x, y = points[..., 0], points[..., 1]
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if ay != by:
            result ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return result


def _poisson(inside: Bools) -> Floats:
    """Solve lap u = -1 in the unit of the grid, u = 0 at the points outside."""
    number = np.full(inside.shape, -1)
    count = int(inside.sum())
    number[inside] = np.arange(count)
    place = np.argwhere(inside)
    matrix = sparse.diags([4.0], [0], shape=(count, count)).tocsr()
    for offset in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        neighbour = number[tuple((place + offset).T)]
        has = np.flatnonzero(neighbour >= 0)
        matrix = matrix - sparse.csr_matrix((np.ones(len(has)), (has, neighbour[has])), shape=(count, count))
    speed = np.zeros(inside.shape)
    speed[inside] = spsolve(matrix.tocsc(), np.ones(count))
    return speed
