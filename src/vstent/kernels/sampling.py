"""Interpolation of a field on sparse grid cells, streamlines, and gradients at the wall.

Fields are (n, d) arrays over cells. `index` (i, j, k) holds the cell number at every grid point, -1 outside. Points are
in grid units, with cell centres at integers.
"""

from typing import Any

import numpy as np
from numba import njit, prange


@njit(cache=True, inline="always")
def _cell_at(index: Any, i: int, j: int, k: int) -> int:
    """Return the cell number at a grid point, -1 outside."""
    if 0 <= i < index.shape[0] and 0 <= j < index.shape[1] and 0 <= k < index.shape[2]:
        return index[i, j, k]
    return -1


@njit(cache=True)
def stencil(index: Any, x: float, y: float, z: float, cells: Any, weights: Any) -> float:
    """Write the eight `cells` around a point and their trilinear `weights`; return the sum of the weights inside."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    a, b, c = x - i, y - j, z - k
    inside = 0.0
    for n in range(8):
        di, dj, dk = n >> 2, (n >> 1) & 1, n & 1
        cells[n] = _cell_at(index, i + di, j + dj, k + dk)
        weights[n] = (a if di else 1.0 - a) * (b if dj else 1.0 - b) * (c if dk else 1.0 - c)
        if cells[n] >= 0:
            inside += weights[n]
    return inside


@njit(cache=True)
def stencils(index: Any, points: Any) -> tuple[Any, Any]:
    """Return the eight cells (m, 8) around points (m, 3), -1 outside, and their trilinear weights (m, 8)."""
    cells = np.zeros((len(points), 8), np.int32)
    weights = np.zeros((len(points), 8))
    for m in range(len(points)):
        stencil(index, points[m, 0], points[m, 1], points[m, 2], cells[m], weights[m])
    return cells, weights


@njit(cache=True, parallel=True, nogil=True)
def interpolate(index: Any, values: Any, points: Any, is_zero_outside: bool) -> Any:
    """Return trilinearly interpolated values (m, d) at points (m, 3); zero where no cell is near.

    Cells outside count as zero where `is_zero_outside`, as for a velocity with no slip; otherwise they are left out, as
    for a pressure.
    """
    result = np.zeros((len(points), values.shape[1]))
    for m in prange(len(points)):
        cells = np.zeros(8, np.int32)
        weights = np.zeros(8)
        inside = stencil(index, points[m, 0], points[m, 1], points[m, 2], cells, weights)
        if inside <= 0.0:
            continue
        scale = 1.0 if is_zero_outside else 1.0 / inside
        for n in range(8):
            if cells[n] >= 0:
                for d in range(values.shape[1]):
                    result[m, d] += scale * weights[n] * values[cells[n], d]
    return result


@njit(cache=True, parallel=True, nogil=True)
def interpolate_cubic(index: Any, values: Any, points: Any) -> Any:
    """Return tricubic values (m, d) at points (m, 3) from the 64 cells around each; cells outside count as zero."""
    result = np.zeros((len(points), values.shape[1]))
    for m in prange(len(points)):
        weights = np.zeros((3, 4))
        for axis in range(3):  # cubic Lagrange interpolation at t between values at -1, 0, 1 and 2
            t = points[m, axis] - np.floor(points[m, axis])
            weights[axis, 0] = -t * (t - 1.0) * (t - 2.0) / 6.0
            weights[axis, 1] = (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0
            weights[axis, 2] = -(t + 1.0) * t * (t - 2.0) / 2.0
            weights[axis, 3] = (t + 1.0) * t * (t - 1.0) / 6.0
        i, j, k = int(np.floor(points[m, 0])), int(np.floor(points[m, 1])), int(np.floor(points[m, 2]))
        for n in range(64):
            a, b, c = n >> 4, (n >> 2) & 3, n & 3
            cell = _cell_at(index, i + a - 1, j + b - 1, k + c - 1)
            if cell >= 0:
                weight = weights[0, a] * weights[1, b] * weights[2, c]
                for d in range(values.shape[1]):
                    result[m, d] += weight * values[cell, d]
    return result


@njit(cache=True)
def _speed_at(index: Any, velocity: Any, p: Any, v: Any, cells: Any, weights: Any) -> float:
    """Write the velocity at p into v; return its magnitude, or -1 outside."""
    v[:] = 0.0
    if stencil(index, p[0], p[1], p[2], cells, weights) <= 0.3:
        return -1.0
    for n in range(8):
        if cells[n] >= 0:
            for d in range(3):
                v[d] += weights[n] * velocity[cells[n], d]
    return np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@njit(cache=True)
def _trace(index: Any, velocity: Any, seed: Any, step: float, slowest: float, path: Any) -> int:
    """Write a streamline from a seed into `path` (m, 4), as points and speeds, and return the number of points."""
    cells, weights = np.zeros(8, np.int32), np.zeros(8)
    k, total, p, q = np.zeros(3), np.zeros(3), seed.copy(), np.zeros(3)
    for m in range(len(path)):
        here = _speed_at(index, velocity, p, k, cells, weights)
        if here < slowest:
            return m
        path[m, :3], path[m, 3] = p, here
        total[:] = k / here
        for stage in range(3):
            part = step if stage == 2 else 0.5 * step
            q[:] = p + part * k / here
            here = _speed_at(index, velocity, q, k, cells, weights)
            if here < slowest:
                return m + 1
            total += (1.0 if stage == 2 else 2.0) * k / here
        p += step * total / 6.0
    return len(path)


@njit(cache=True, parallel=True)
def trace_all(index: Any, velocity: Any, seeds: Any, step: float, slowest: float, most: int) -> tuple[Any, Any]:
    """Return streamlines from seeds (s, 3), integrated with the classical fourth-order Runge-Kutta method.

    The integration runs over arc length, so that slow blood needs no more points than fast blood. A streamline ends
    outside the cells, below the speed `slowest`, or after `most` points. Steps of negative length lead upstream.

    Returns points and speeds (s, most, 4), and the number (s,) of points of each streamline.
    """
    path = np.zeros((len(seeds), most, 4))
    count = np.zeros(len(seeds), np.int32)
    for s in prange(len(seeds)):
        count[s] = _trace(index, velocity, seeds[s], step, slowest, path[s])
    return path, count


@njit(cache=True)
def _solve(matrix: Any, right: Any) -> None:
    """Solve a small symmetric positive system in place for several right sides; a vanishing pivot drops its unknown."""
    n = len(matrix)
    floor = 1e-9 * matrix[0, 0]
    for i in range(n):
        if matrix[i, i] <= floor:
            matrix[i, :] = 0.0
            matrix[:, i] = 0.0
            right[i, :] = 0.0
            matrix[i, i] = 1.0
        for j in range(i + 1, n):
            ratio = matrix[j, i] / matrix[i, i]
            matrix[j, i:] -= ratio * matrix[i, i:]
            right[j, :] -= ratio * right[i, :]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            right[i, :] -= matrix[i, j] * right[j, :]
        right[i, :] /= matrix[i, i]


# Arithmetic on small arrays in a parallel function takes seconds to compile.
@njit(cache=True)
def _tangents(x: float, y: float, z: float) -> Any:
    """Return two unit tangents, of three numbers each, of a unit normal."""
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        u, v, w = 0.0, z, -y
    elif abs(y) <= abs(z):
        u, v, w = -z, 0.0, x
    else:
        u, v, w = y, -x, 0.0
    length = np.sqrt(u * u + v * v + w * w)
    u, v, w = u / length, v / length, w / length
    return (u, v, w), (y * w - z * v, z * u - x * w, x * v - y * u)


@njit(cache=True, parallel=True, nogil=True)
def fit_wall(index: Any, distance: Any, velocity: Any, pressure: Any, points: Any, normals: Any, reach: int) -> Any:
    """Return the wall-normal velocity gradient (3) and the pressure at wall points with inward unit normals, (m, 4).

    Both are weighted least-squares fits over the cells within `reach` of a point, with d the distance of the cell from
    the wall and s, t tangential coordinates, all in cells:

    velocity = d (a + b d + c s + e t + g d^2), zero at the wall, cubic away from it and linear along it. It is exact
    for Poiseuille flow in a straight tube; the cubic term represents the curvature near the wall in a pulse.

    pressure = a + b d + c s + e t.
    """
    result = np.zeros((len(points), 4))
    for m in prange(len(points)):
        p, normal = points[m], normals[m]
        first, second = _tangents(normal[0], normal[1], normal[2])
        shear, level = np.zeros((5, 5)), np.zeros((4, 4))
        shear_right, level_right = np.zeros((5, 3)), np.zeros((4, 1))
        base = np.zeros(5)
        lowest = np.floor(p).astype(np.int64) - reach + 1
        for i in range(lowest[0], lowest[0] + 2 * reach):
            for j in range(lowest[1], lowest[1] + 2 * reach):
                for k in range(lowest[2], lowest[2] + 2 * reach):
                    cell = _cell_at(index, i, j, k)
                    if cell < 0:
                        continue
                    x, y, z = i - p[0], j - p[1], k - p[2]
                    away = x * x + y * y + z * z
                    inward = x * normal[0] + y * normal[1] + z * normal[2]
                    if away >= reach * reach or inward < -0.2 * reach:
                        continue
                    d = distance[cell]
                    weight = (1.0 - away / (reach * reach)) ** 2
                    base[0], base[1] = 1.0, d
                    base[2] = x * first[0] + y * first[1] + z * first[2]
                    base[3] = x * second[0] + y * second[1] + z * second[2]
                    base[4] = d * d
                    for a in range(4):
                        for b in range(4):
                            level[a, b] += weight * base[a] * base[b]
                        level_right[a, 0] += weight * base[a] * pressure[cell]
                    for a in range(5):
                        for b in range(5):
                            shear[a, b] += weight * d * d * base[a] * base[b]
                        for axis in range(3):
                            shear_right[a, axis] += weight * d * base[a] * velocity[cell, axis]
        if level[0, 0] <= 0.0:
            continue
        _solve(shear, shear_right)
        _solve(level, level_right)
        for axis in range(3):
            result[m, axis] = shear_right[0, axis]
        result[m, 3] = level_right[0, 0]
    return result
