"""Coverage: which part of a grid of quads lies under wires."""

from typing import Any

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from vstent.kernels.arrays import Floats


def covered_fractions(nodes: Floats, starts: Floats, ends: Floats, radius: Floats, samples: int) -> Floats:
    """Part (rows - 1, columns) of every quad of a contour that wires hide.

    Parameters
    ----------
    nodes : (rows, columns, 3) grid, columns periodic.
    starts, ends : (m, 3) segments of wire axes, shorter than the grid's spacing.
    radius : (m,) half-widths of the wires.
    samples : points tried per quad and direction.

    Points of a low-discrepancy lattice, shifted anew in every quad so that no pattern of wires can hide between them,
    are tested against the segments nearby, all projected onto the quad's plane.
    """
    rows, columns = nodes.shape[:2]
    home = np.asarray(cKDTree(nodes.reshape(-1, 3)).query(0.5 * (starts + ends))[1])
    order = np.argsort(home, kind="stable")
    first = np.searchsorted(home[order], np.arange(rows * columns + 1)).astype(np.int32)
    return _fractions(
        np.ascontiguousarray(nodes),
        np.ascontiguousarray(starts[order]),
        np.ascontiguousarray(ends[order]),
        np.ascontiguousarray(radius[order]),
        first,
        samples,
    )


@njit(cache=True)
def _gather(first: Any, row: int, column: int, rows: int, columns: int, found: Any) -> int:
    """Put the segments at home within one node of a quad into `found`; return how many."""
    n = 0
    for i in range(max(0, row - 1), min(rows, row + 3)):
        for step in range(-1, 3):
            node = i * columns + (column + step) % columns
            for k in range(first[node], min(first[node + 1], first[node] + found.size - n)):
                found[n] = k
                n += 1
    return n


@njit(cache=True)
def _unit_normal(corners: Any, normal: Any) -> None:
    """Write the unit normal of a quad (4, 3) from its diagonals."""
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        normal[k] = (corners[3, i] - corners[0, i]) * (corners[2, j] - corners[1, j]) - (
            corners[3, j] - corners[0, j]
        ) * (corners[2, i] - corners[1, i])
    length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    for k in range(3):
        normal[k] /= length


@njit(cache=True)
def _is_under(point: Any, normal: Any, starts: Any, ends: Any, radius: Any, near: Any, n_near: int) -> bool:
    for i in range(n_near):
        k = near[i]
        ax, ay, az = point[0] - starts[k, 0], point[1] - starts[k, 1], point[2] - starts[k, 2]
        bx, by, bz = ends[k, 0] - starts[k, 0], ends[k, 1] - starts[k, 1], ends[k, 2] - starts[k, 2]
        an = ax * normal[0] + ay * normal[1] + az * normal[2]
        bn = bx * normal[0] + by * normal[1] + bz * normal[2]
        ax, ay, az = ax - an * normal[0], ay - an * normal[1], az - an * normal[2]
        bx, by, bz = bx - bn * normal[0], by - bn * normal[1], bz - bn * normal[2]
        t = (ax * bx + ay * by + az * bz) / max(bx * bx + by * by + bz * bz, 1e-300)
        t = min(max(t, 0.0), 1.0)
        dx, dy, dz = ax - t * bx, ay - t * by, az - t * bz
        if dx * dx + dy * dy + dz * dz < radius[k] * radius[k]:
            return True
    return False


@njit(cache=True)
def _fractions(nodes: Any, starts: Any, ends: Any, radius: Any, first: Any, samples: int) -> Any:
    rows, columns = nodes.shape[0], nodes.shape[1]
    result = np.zeros((rows - 1, columns))
    near = np.zeros(4096, dtype=np.int32)
    corners, normal, point = np.zeros((4, 3)), np.zeros(3), np.zeros(3)
    for quad in range((rows - 1) * columns):
        i, j = quad // columns, quad % columns
        for k in range(3):
            corners[0, k], corners[1, k] = nodes[i, j, k], nodes[i, (j + 1) % columns, k]
            corners[2, k], corners[3, k] = nodes[i + 1, j, k], nodes[i + 1, (j + 1) % columns, k]
        _unit_normal(corners, normal)
        n_near = _gather(first, i, j, rows, columns, near)
        hits = 0
        for sample in range(samples * samples):
            # R2 sequence (Roberts 2018), its start moved from quad to quad by the same kind of numbers.
            u = (0.5 + 0.7548776662466927 * sample + 0.5698402909980532 * quad) % 1.0
            v = (0.5 + 0.5698402909980532 * sample + 0.3247179572447460 * quad) % 1.0
            for k in range(3):
                low = (1 - v) * corners[0, k] + v * corners[1, k]
                point[k] = (1 - u) * low + u * ((1 - v) * corners[2, k] + v * corners[3, k])
            if _is_under(point, normal, starts, ends, radius, near, n_near):
                hits += 1
        result[i, j] = hits / (samples * samples)
    return result
