"""Metal coverage: the fraction of each cell of a quadrilateral grid that lies under wires."""

from typing import Any

import numpy as np
from numba import njit

from vstent.kernels.arrays import Floats


def covered_fractions(nodes: Floats, starts: Floats, ends: Floats, radius: Floats, samples: int) -> Floats:
    """Return the fraction (rows - 1, columns) of every cell of a grid (rows, columns, 3) that is covered by wires.

    Sample points of a low-discrepancy sequence, `samples` per direction, are tested against nearby wire segments (m, 3)
    of half-widths `radius` (m,), all projected onto the plane of the cell. The sequence has a different offset in every
    cell, so that a regular wire pattern cannot fall between the points. Columns are periodic, and the segments must be
    shorter than the grid spacing.
    """
    nodes = np.array(nodes, order="C")  # a writable copy: numba compiles separate code for read-only arrays
    home = homes(nodes, 0.5 * (starts + ends))
    order = np.argsort(home, kind="stable")
    first = np.searchsorted(home[order], np.arange(nodes.shape[0] * nodes.shape[1] + 1)).astype(np.int32)
    starts, ends, radius = (np.ascontiguousarray(values[order]) for values in (starts, ends, radius))
    return _fractions(nodes, starts, ends, radius, first, samples)


@njit(cache=True)
def homes(nodes: Any, points: Any) -> Any:
    """Return the number (n,) of the node of a grid (rows, columns, 3) nearest to each of consecutive points (n, 3).

    Each search starts from the node of the previous point; if the points are too far apart, all nodes are tried.
    """
    rows, columns = nodes.shape[0], nodes.shape[1]
    home = np.zeros(len(points), dtype=np.int32)
    row, column = 0, 0
    for p in range(len(points)):
        jump2, reach2 = 0.0, 0.0
        for k in range(3):
            jump2 += (points[p, k] - points[p - 1, k]) ** 2 if p > 0 else 0.0
            reach2 += (nodes[row, (column + 1) % columns, k] - nodes[row, column, k]) ** 2
        if p == 0 or jump2 > reach2:
            nearest2 = np.inf
            for i in range(rows):
                for j in range(columns):
                    away2 = _away2(nodes, points[p], i, j)
                    if away2 < nearest2:
                        nearest2, row, column = away2, i, j
        row, column = _downhill(nodes, points[p], row, column)
        home[p] = row * columns + column
    return home


@njit(cache=True)
def _away2(nodes: Any, point: Any, row: int, column: int) -> float:
    """Return the squared distance of a point from a node."""
    total = 0.0
    for k in range(3):
        total += (nodes[row, column, k] - point[k]) ** 2
    return total


@njit(cache=True)
def _downhill(nodes: Any, point: Any, row: int, column: int) -> tuple[int, int]:
    """Return row and column of the nearest node, found by moving to nearer neighbours until there is none."""
    rows, columns = nodes.shape[0], nodes.shape[1]
    best = _away2(nodes, point, row, column)
    while True:
        here = row, column
        for i in range(max(here[0] - 1, 0), min(here[0] + 2, rows)):
            for step in range(-1, 2):
                j = (here[1] + step) % columns
                away2 = _away2(nodes, point, i, j)
                if away2 < best:
                    best, row, column = away2, i, j
        if (row, column) == here:
            return row, column


@njit(cache=True)
def _gather(first: Any, row: int, column: int, rows: int, columns: int, near: Any) -> int:
    """Write the segments whose home is within one node of a cell into `near` and return their number."""
    n = 0
    for i in range(max(0, row - 1), min(rows, row + 3)):
        for step in range(-1, 3):
            node = i * columns + (column + step) % columns
            for k in range(first[node], min(first[node + 1], first[node] + near.size - n)):
                near[n] = k
                n += 1
    return n


@njit(cache=True)
def _plane(corners: Any, frame: Any) -> float:
    """Write the centre and two in-plane unit vectors of a cell into `frame` (3, 3); return its half-diagonal."""
    for k in range(3):
        frame[0, k] = 0.25 * (corners[0, k] + corners[1, k] + corners[2, k] + corners[3, k])
        frame[1, k], frame[2, k] = corners[3, k] - corners[0, k], corners[2, k] - corners[1, k]
    reach2 = 0.0
    for corner in range(4):
        away2 = 0.0
        for k in range(3):
            away2 += (corners[corner, k] - frame[0, k]) ** 2
        reach2 = max(reach2, away2)
    for i in range(1, 3):
        share = frame[2, 0] * frame[1, 0] + frame[2, 1] * frame[1, 1] + frame[2, 2] * frame[1, 2] if i == 2 else 0.0
        for k in range(3):
            frame[i, k] -= share * frame[1, k]
        length = np.sqrt(frame[i, 0] ** 2 + frame[i, 1] ** 2 + frame[i, 2] ** 2)
        for k in range(3):
            frame[i, k] /= length
    return np.sqrt(reach2)


@njit(cache=True)
def _flatten(frame: Any, reach: float, starts: Any, ends: Any, radius: Any, near: Any, flat: Any) -> int:
    """Write nearby segments projected onto the cell's plane into `flat`: start, vector, 1 / length^2, radius^2."""
    n = 0
    for i in range(len(near)):
        k = near[i]
        ax, ay, bx, by = 0.0, 0.0, 0.0, 0.0
        for axis in range(3):
            a, b = starts[k, axis] - frame[0, axis], ends[k, axis] - starts[k, axis]
            ax, ay = ax + a * frame[1, axis], ay + a * frame[2, axis]
            bx, by = bx + b * frame[1, axis], by + b * frame[2, axis]
        length2 = max(bx * bx + by * by, 1e-300)
        t = min(max(-(ax * bx + ay * by) / length2, 0.0), 1.0)
        if np.sqrt((ax + t * bx) ** 2 + (ay + t * by) ** 2) > reach + radius[k]:
            continue
        flat[n, 0], flat[n, 1], flat[n, 2], flat[n, 3] = ax, ay, bx, by
        flat[n, 4], flat[n, 5] = 1.0 / length2, radius[k] * radius[k]
        n += 1
    return n


@njit(cache=True)
def _is_under(x: float, y: float, flat: Any) -> bool:
    """Return whether the point x, y lies under one of the projected segments."""
    for i in range(len(flat)):
        px, py, bx, by = x - flat[i, 0], y - flat[i, 1], flat[i, 2], flat[i, 3]
        t = min(max((px * bx + py * by) * flat[i, 4], 0.0), 1.0)
        dx, dy = px - t * bx, py - t * by
        if dx * dx + dy * dy < flat[i, 5]:
            return True
    return False


@njit(cache=True)
def _fractions(nodes: Any, starts: Any, ends: Any, radius: Any, first: Any, samples: int) -> Any:
    """Return the covered fractions (rows - 1, columns) of all cells."""
    rows, columns = nodes.shape[0], nodes.shape[1]
    result = np.zeros((rows - 1, columns))
    near, flat = np.zeros(4096, dtype=np.int32), np.zeros((4096, 6))
    corners, frame, at = np.zeros((4, 3)), np.zeros((3, 3)), np.zeros((4, 2))
    for quad in range((rows - 1) * columns):
        row, column = quad // columns, quad % columns
        for k in range(3):
            corners[0, k], corners[1, k] = nodes[row, column, k], nodes[row, (column + 1) % columns, k]
            corners[2, k], corners[3, k] = nodes[row + 1, column, k], nodes[row + 1, (column + 1) % columns, k]
        reach = _plane(corners, frame)
        n_near = _gather(first, row, column, rows, columns, near)
        n_flat = _flatten(frame, reach, starts, ends, radius, near[:n_near], flat)
        at[:] = 0.0
        for corner in range(4):
            for k in range(3):
                off = corners[corner, k] - frame[0, k]
                at[corner, 0] += off * frame[1, k]
                at[corner, 1] += off * frame[2, k]
        hits = 0
        for sample in range(samples * samples):
            # R2 sequence (Roberts 2018), with an offset per cell from a sequence of the same kind.
            u = (0.5 + 0.7548776662466927 * sample + 0.5698402909980532 * quad) % 1.0
            v = (0.5 + 0.5698402909980532 * sample + 0.3247179572447460 * quad) % 1.0
            a, b, c, d = (1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v
            x = a * at[0, 0] + b * at[1, 0] + c * at[2, 0] + d * at[3, 0]
            y = a * at[0, 1] + b * at[1, 1] + c * at[2, 1] + d * at[3, 1]
            hits += _is_under(x, y, flat[:n_flat])
        result[row, column] = hits / (samples * samples)
    return result
