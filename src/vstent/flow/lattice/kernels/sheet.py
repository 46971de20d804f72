"""Distribution of a thin resisting sheet, given as sample points, over the grid cells around it."""

from typing import Any, Final

import numpy as np
from numba import njit

from vstent.kernels import sampling

COLUMNS: Final = 7
"""Number of sums in every cell: three of the normal, resistance along and across it, its square, inertial loss."""


@njit(cache=True)
def spread(index: Any, frame: Any, sheet: Any, number: Any, found: Any, sums: Any) -> int:
    """Share the samples of a sheet among the eight cells around each; return how many cells receive something.

    `index` (i, j, k) holds the number of the cell at every grid point, -1 outside; `frame` (4,) the position of grid
    point 0, 0, 0 and the grid spacing; `sheet` the samples (p, 3), unit normals (p, 3) and per sample (p,) the area per
    volume of a cell, the resistances along the normal and across it, and the inertial loss.

    `number` (cells,), filled with -1, is set to the row of every cell that receives something, `found` (cells,) to the
    cell of every row, and `sums` (cells, `COLUMNS`), filled with zeros, to the sums over the samples of every row, per
    volume: normal (3), resistance along and across it, square of the latter times `_twice`, inertial loss.
    """
    points, normals, area, along, across, loss = sheet
    cells, weights, height = np.zeros(8, np.int32), np.zeros(8), np.zeros(8)
    rows = 0
    for p in range(len(points)):
        at = (points[p] - frame[:3]) / frame[3]
        if sampling.stencil(index, at[0], at[1], at[2], cells, weights) <= 0.0:
            continue
        normal = normals[p]
        squared = _twice(weights, normal, height) * (across[p] * across[p])
        for n in range(8):
            cell = cells[n]
            if cell < 0 or weights[n] <= 0.0:
                continue
            if number[cell] < 0:
                number[cell], found[rows] = rows, cell
                rows += 1
            row, share = number[cell], weights[n] * area[p]
            for k in range(3):
                sums[row, k] += share * normal[k]
            sums[row, 3] += share * along[p]
            sums[row, 4] += share * across[p]
            sums[row, 5] += share * squared
            sums[row, 6] += share * loss[p]
    return rows


@njit(cache=True)
def _twice(weights: Any, normal: Any, height: Any) -> float:
    """Return the sum, over pairs of the eight cells, of weight * weight * distance along the normal.

    The heights (8,) of the cells along the normal are written into `height`.
    """
    total = 0.0
    for a in range(8):
        height[a] = normal[0] * (a >> 2) + normal[1] * ((a >> 1) & 1) + normal[2] * (a & 1)
        to_all = 0.0
        for b in range(a):
            to_all += weights[b] * abs(height[a] - height[b])
        total += weights[a] * to_all
    return total
