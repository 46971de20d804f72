"""Footprints of cubic cells on a detector in a cone beam.

A cell is divided into equal parts that are no larger than a pixel on the detector. The volume of each part, times its
weight in the line integral, is spread over a square as wide as the part, whose variance is that of the part in every
direction, and shared among the pixels that the square overlaps. For a cube seen along an edge this is exact.
"""

from typing import Any

import numpy as np
from numba import njit, prange

MAX_PARTS = 12
"""Largest number of parts along an edge of a cell."""


@njit(cache=True)
def _entries(seen: Any, spacing: float, axes: Any, geometry: Any, shape: Any) -> tuple[Any, Any]:
    """Return the numbers and weights of the pixels in the footprint of a cell."""
    pixel, detector, isocenter = geometry[0], geometry[1], geometry[2]
    reach = 0.5 * np.sqrt(3.0) * spacing
    nearest = detector / (isocenter + seen[2] - reach) / pixel
    middle = detector / (isocenter + seen[2]) / pixel
    row, column = geometry[3] - seen[1] * middle, geometry[4] + seen[0] * middle
    aside = max(abs(seen[0]), abs(seen[1])) * (nearest - middle)
    margin = reach * nearest + aside + 1.5
    first_row, first_column = int(np.floor(row - margin)), int(np.floor(column - margin))
    out = np.zeros((int(np.ceil(row + margin)) - first_row + 1, int(np.ceil(column + margin)) - first_column + 1))
    n = max(1, min(MAX_PARTS, int(np.ceil(spacing * (detector / (isocenter + seen[2])) / pixel))))
    step = spacing / n
    for k in range(n * n * n):
        x = (k // (n * n) + 0.5) * step - 0.5 * spacing
        y = (k // n % n + 0.5) * step - 0.5 * spacing
        z = (k % n + 0.5) * step - 0.5 * spacing
        right = seen[0] + axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
        up = seen[1] + axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
        depth = isocenter + seen[2] + axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
        scale = detector / (depth * pixel)
        # A ray element dr at a distance r is dV / (r^2 dOmega); a pixel is seen under dOmega = A cos^3 / detector^2.
        weight = step**3 * scale * scale * np.sqrt(1.0 + (right * right + up * up) / (depth * depth))
        half = 0.5 * step * scale
        top = geometry[3] - up * scale - first_row - half + 0.5
        left = geometry[4] + right * scale - first_column - half + 0.5
        weight /= 4.0 * half * half
        for i in range(int(np.floor(top)), int(np.floor(top + 2 * half)) + 1):
            high = min(top + 2 * half, i + 1.0) - max(top, float(i))
            for j in range(int(np.floor(left)), int(np.floor(left + 2 * half)) + 1):
                out[i, j] += weight * high * (min(left + 2 * half, j + 1.0) - max(left, float(j)))
    pixels, weights, n = np.zeros(out.size, np.int32), np.zeros(out.size, np.float32), 0
    for i in range(max(0, -first_row), min(out.shape[0], shape[0] - first_row)):
        for j in range(max(0, -first_column), min(out.shape[1], shape[1] - first_column)):
            if out[i, j] > 0.0:
                pixels[n], weights[n] = (first_row + i) * shape[1] + first_column + j, out[i, j]
                n += 1
    return pixels[:n], weights[:n]


@njit(cache=True, parallel=True)
def footprints(seen: Any, spacing: Any, axes: Any, geometry: Any, shape: Any) -> tuple[Any, Any, Any]:
    """Return the footprints of cells as the columns of a sparse matrix.

    Parameters
    ----------
    seen : (n, 3) cell centers relative to the isocenter, mm: right, up, toward the detector.
    spacing : (n,) edges of the cells, mm.
    axes : (3, 3) right, up and toward the detector as rows in the axes of the cells.
    geometry : (5,) pixel, source-detector and source-isocenter distance in mm, row and column of the isocenter.
    shape : (2,) rows and columns of the detector.

    Returns
    -------
    starts : (n + 1,) int64; first entry of every cell.
    pixels : (m,) int32; pixel number, row * columns + column, of every entry.
    weights : (m,) float32; length in mm over which a ray to the pixel crosses the cell, averaged over the pixel.
    """
    starts = np.zeros(len(seen) + 1, np.int64)
    for c in prange(len(seen)):
        starts[c + 1] = len(_entries(seen[c], spacing[c], axes, geometry, shape)[0])
    starts = np.cumsum(starts)
    pixels, weights = np.zeros(starts[-1], np.int32), np.zeros(starts[-1], np.float32)
    for c in prange(len(seen)):
        if starts[c + 1] > starts[c]:
            entries = _entries(seen[c], spacing[c], axes, geometry, shape)
            pixels[starts[c] : starts[c + 1]], weights[starts[c] : starts[c + 1]] = entries
    return starts, pixels, weights
