"""Net: crossings that slide on a grid of nodes until pieces of wire between them are as long as they were made.

Crossings x (c, 2), moves along and around in mm, are those of least

    sum over pieces of (length - length as made)^2
    +  sum over crossings of (resistance times how far they move otherwise than their row)^2
    +  sum over neighbours in a row of (crowding times how much nearer together or further apart they come)^2
    +  sum over neighbours on a wire of (stiffness times the second difference of their moves)^2

with the mean of one row held where it is. Gauss-Newton steps; every one solves its normal equations by conjugate
gradients, preconditioned by the diagonal and by one coarse problem: whole rows moved, tilted, turned and bunched.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit

from vstent.kernels.arrays import Floats, Ints

_WAVES: Final = 6
"""Moves of a row in the coarse problem: 1, cos, sin along and around."""
_BAND: Final = 2 * _WAVES
"""Width of its matrix: a row and the next."""


REACH: Final = 0.3
"""A crossing moves no further in a step, mm."""
SHORTEST: Final = 0.05
"""A step that does not help is halved down to this."""
ROUNDS: Final = 200
"""Of conjugate gradients, at most."""


class Net(NamedTuple):
    """Crossings, and pieces of wire from each row of them to the next."""

    chart: Floats
    """(rows, columns, 9) the grid they slide on: nodes, derivatives per mm along and around."""
    row: Ints
    """(c,) row of the grid on which every crossing lies before it slides."""
    column: Ints
    """(c,) and its column."""
    line: Ints
    """(c,) row of crossings, rising, that every crossing belongs to."""
    beside: Ints
    """(c,) next crossing in the same row."""
    ends: Ints
    """(2, p) crossings at the two ends of every piece, in rows one after the other."""
    spacing: Floats
    """(2,) mm per row and per column of the grid."""
    bulge: Floats
    """(l,) mm2: wires follow the wall, so much more than its chord's is the squared length of a piece behind a row."""
    bends: Ints
    """(3, b) every three crossings that follow on each other on a wire."""


class Weights(NamedTuple):
    """What the crossings heed."""

    length: float
    """Length of a piece as made."""
    resistance: float
    """Weight of a crossing that moves otherwise than its row against a piece that stretches by as much."""
    crowding: float
    """Weight of neighbours in a row that come nearer together."""
    stiffness: float
    """Weight of wires that bend otherwise."""
    held: int
    """The row of crossings that stays where it is in the mean."""


def slide(net: Net, weights: Weights, steps: int, gain: float, tolerance: float) -> Floats:
    """Moves (c, 2) of the crossings, along and around, mm."""
    angle = 2 * np.pi * net.column / net.chart.shape[1]
    waves = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    return _slide(*net, *weights, waves, steps, gain, tolerance)


@njit(cache=True, nogil=True)
def _put(chart: Any, row: Any, column: Any, spacing: Any, x: Any, places: Any) -> None:
    """Write the chart's values (c, 9) where the crossings are; beyond its rows it goes on in straight lines."""
    rows, columns = chart.shape[0], chart.shape[1]
    for c in range(len(row)):
        along, around = row[c] + x[c, 0] / spacing[0], column[c] + x[c, 1] / spacing[1]
        i, j = min(max(int(np.floor(along)), 0), rows - 2), int(np.floor(around))
        down, right = along - i, around - j
        j, beyond = j % columns, (j + 1) % columns
        for k in range(9):
            above = (1 - right) * chart[i, j, k] + right * chart[i, beyond, k]
            below = (1 - right) * chart[i + 1, j, k] + right * chart[i + 1, beyond, k]
            places[c, k] = (1 - down) * above + down * below


@njit(cache=True, nogil=True)
def _cost(
    places: Any, line: Any, beside: Any, ends: Any, bulge: Any, bends: Any, weights: Any, x: Any, excess: Any
) -> float:
    """Write by how much every piece (p,) is too long; return what the crossings minimise."""
    length, resistance, crowding, stiffness, held = weights
    total = 0.0
    for p in range(ends.shape[1]):
        a, b = ends[0, p], ends[1, p]
        way = bulge[line[a]]
        for k in range(3):
            way += (places[b, k] - places[a, k]) ** 2
        excess[p] = np.sqrt(way) - length
        total += excess[p] ** 2
    mean, count = _row_means(line, x)
    for c in range(len(line)):
        off = x[c, 0] - mean[line[c]]
        total += resistance**2 * (off * off + x[c, 1] ** 2)
        total += (crowding * (x[beside[c], 1] - x[c, 1])) ** 2
    for b in range(bends.shape[1]):
        for k in range(2):
            total += (stiffness * (x[bends[0, b], k] - 2 * x[bends[1, b], k] + x[bends[2, b], k])) ** 2
    return total + count[held] * mean[held] ** 2


@njit(cache=True, nogil=True)
def _row_means(line: Any, x: Any) -> tuple[Any, Any]:
    """Mean move along (l,) of every row of crossings, and how many they are."""
    mean, count = np.zeros(line[-1] + 1), np.zeros(line[-1] + 1)
    for c in range(len(line)):
        mean[line[c]] += x[c, 0]
        count[line[c]] += 1.0
    for row in range(len(mean)):
        mean[row] /= count[row]
    return mean, count


@njit(cache=True, nogil=True)
def _slopes(places: Any, ends: Any, slopes: Any) -> None:
    """Write the derivative (p, 4) of every piece's length by its first end's two moves and its last end's."""
    for p in range(ends.shape[1]):
        a, b = ends[0, p], ends[1, p]
        d0, d1, d2 = places[b, 0] - places[a, 0], places[b, 1] - places[a, 1], places[b, 2] - places[a, 2]
        way = max(np.sqrt(d0 * d0 + d1 * d1 + d2 * d2), 1e-12)
        for k in range(2):
            q = 3 + 3 * k
            slopes[p, k] = -(d0 * places[a, q] + d1 * places[a, q + 1] + d2 * places[a, q + 2]) / way
            slopes[p, 2 + k] = (d0 * places[b, q] + d1 * places[b, q + 1] + d2 * places[b, q + 2]) / way


@njit(cache=True, nogil=True)
def _multiply(slopes: Any, line: Any, beside: Any, ends: Any, bends: Any, weights: Any, x: Any, result: Any) -> None:
    """Write the normal matrix times x (c, 2)."""
    _, resistance, crowding, stiffness, held = weights
    mean, _ = _row_means(line, x)
    damp, crowd, stiff = resistance**2, crowding**2, stiffness**2
    for c in range(len(line)):
        result[c, 0] = damp * (x[c, 0] - mean[line[c]])
        result[c, 1] = damp * x[c, 1]
        if line[c] == held:
            result[c, 0] += mean[held]
    for c in range(len(line)):
        nearer = crowd * (x[beside[c], 1] - x[c, 1])
        result[beside[c], 1] += nearer
        result[c, 1] -= nearer
    for b in range(bends.shape[1]):
        before, here, after = bends[0, b], bends[1, b], bends[2, b]
        for k in range(2):
            bent = stiff * (x[before, k] - 2 * x[here, k] + x[after, k])
            result[before, k] += bent
            result[here, k] -= 2 * bent
            result[after, k] += bent
    for p in range(ends.shape[1]):
        a, b = ends[0, p], ends[1, p]
        longer = slopes[p, 0] * x[a, 0] + slopes[p, 1] * x[a, 1] + slopes[p, 2] * x[b, 0] + slopes[p, 3] * x[b, 1]
        result[a, 0] += slopes[p, 0] * longer
        result[a, 1] += slopes[p, 1] * longer
        result[b, 0] += slopes[p, 2] * longer
        result[b, 1] += slopes[p, 3] * longer


@njit(cache=True, nogil=True)
def _diagonal(slopes: Any, ends: Any, weights: Any, n: int) -> Any:
    """Inverse of the normal matrix's diagonal (c, 2)."""
    _, resistance, crowding, stiffness, _ = weights
    inverse = np.zeros((n, 2))
    for p in range(ends.shape[1]):
        for k in range(2):
            inverse[ends[0, p], k] += slopes[p, k] ** 2
            inverse[ends[1, p], k] += slopes[p, 2 + k] ** 2
    for c in range(n):
        for k in range(2):  # on two wires (1, -2, 1) comes thrice
            inverse[c, k] = 1 / (inverse[c, k] + resistance**2 + 12 * stiffness**2 + 2 * k * crowding**2)
    return inverse


@njit(cache=True, nogil=True)
def _coarse(slopes: Any, line: Any, beside: Any, ends: Any, weights: Any, waves: Any) -> Any:
    """Banded Cholesky factor (n, BAND), lower form, of the normal matrix on moves of whole rows."""
    _, resistance, crowding, _stiffness, held = weights
    band = np.zeros(((line[-1] + 1) * _WAVES, _BAND))
    g = np.zeros(_BAND)
    for p in range(ends.shape[1]):
        a, b = ends[0, p], ends[1, p]
        for w in range(3):
            g[w], g[3 + w] = slopes[p, 0] * waves[a, w], slopes[p, 1] * waves[a, w]
            g[6 + w], g[9 + w] = slopes[p, 2] * waves[b, w], slopes[p, 3] * waves[b, w]
        first = line[a] * _WAVES
        for i in range(_BAND):
            for j in range(i + 1):
                band[first + i, i - j] += g[i] * g[j]
    for c in range(len(line)):
        first = line[c] * _WAVES
        for w in range(3):
            for v in range(w + 1):
                both = waves[c, w] * waves[c, v]
                apart = (waves[beside[c], w] - waves[c, w]) * (waves[beside[c], v] - waves[c, v])
                if w > 0:
                    band[first + w, w - v] += resistance**2 * both
                band[first + 3 + w, w - v] += resistance**2 * both + crowding**2 * apart
        if line[c] == held:
            band[held * _WAVES, 0] += 1.0
    return _cholesky(band)


@njit(cache=True, nogil=True)
def _cholesky(band: Any) -> Any:
    """Factor in place a symmetric matrix whose entry (i, i - k) is band[i, k]."""
    n, width = band.shape
    for i in range(n):
        for k in range(min(i, width - 1), -1, -1):
            j = i - k
            total = band[i, k]
            for m in range(max(0, i - width + 1, j - width + 1), j):
                total -= band[i, i - m] * band[j, j - m]
            if k == 0:
                band[i, 0] = np.sqrt(max(total, 1e-30))
            else:
                band[i, k] = total / band[j, 0]
    return band


@njit(cache=True, nogil=True)
def _solve(factor: Any, right: Any) -> None:
    """Solve in place with a factor of `_cholesky`."""
    n, width = factor.shape
    for i in range(n):
        for k in range(1, min(i, width - 1) + 1):
            right[i] -= factor[i, k] * right[i - k]
        right[i] /= factor[i, 0]
    for i in range(n - 1, -1, -1):
        right[i] /= factor[i, 0]
        for k in range(1, min(i, width - 1) + 1):
            right[i - k] -= factor[i, k] * right[i]


@njit(cache=True, nogil=True)
def _precondition(inverse: Any, factor: Any, line: Any, waves: Any, residual: Any, result: Any) -> None:
    """Write the preconditioner times the residual (c, 2)."""
    rows = np.zeros(len(factor))
    for c in range(len(line)):
        for w in range(3):
            rows[line[c] * _WAVES + w] += waves[c, w] * residual[c, 0]
            rows[line[c] * _WAVES + 3 + w] += waves[c, w] * residual[c, 1]
    _solve(factor, rows)
    for c in range(len(line)):
        for k in range(2):
            result[c, k] = inverse[c, k] * residual[c, k]
            for w in range(3):
                result[c, k] += waves[c, w] * rows[line[c] * _WAVES + 3 * k + w]


@njit(cache=True, nogil=True)
def _dot(a: Any, b: Any) -> float:
    total = 0.0
    for c in range(len(a)):
        total += a[c, 0] * b[c, 0] + a[c, 1] * b[c, 1]
    return total


@njit(cache=True, nogil=True)
def _step(
    slopes: Any,
    line: Any,
    beside: Any,
    ends: Any,
    bends: Any,
    weights: Any,
    waves: Any,
    x: Any,
    excess: Any,
    tolerance: float,
) -> Any:
    """Moves (c, 2) of a Gauss-Newton step from x, by conjugate gradients."""
    inverse, factor = _diagonal(slopes, ends, weights, len(line)), _coarse(slopes, line, beside, ends, weights, waves)
    n = len(line)
    residual, image = np.zeros((n, 2)), np.zeros((n, 2))
    _multiply(np.zeros((len(slopes), 4)), line, beside, ends, bends, weights, x, image)
    for c in range(len(line)):
        residual[c, 0], residual[c, 1] = -image[c, 0], -image[c, 1]
    for p in range(ends.shape[1]):
        for k in range(2):
            residual[ends[0, p], k] -= slopes[p, k] * excess[p]
            residual[ends[1, p], k] -= slopes[p, 2 + k] * excess[p]
    move, way, ready = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 2))
    goal, before = 0.0, np.inf
    for _ in range(ROUNDS):
        _precondition(inverse, factor, line, waves, residual, ready)
        size = _dot(residual, ready)
        goal = max(goal, tolerance**2 * size)
        if size <= goal:
            break
        for c in range(n):
            for k in range(2):
                way[c, k] = ready[c, k] + size / before * way[c, k]
        _multiply(slopes, line, beside, ends, bends, weights, way, image)
        share, before = size / _dot(way, image), size
        for c in range(n):
            for k in range(2):
                move[c, k] += share * way[c, k]
                residual[c, k] -= share * image[c, k]
    return move


@njit(cache=True, nogil=True)
def _slide(
    chart: Any,
    row: Any,
    column: Any,
    line: Any,
    beside: Any,
    ends: Any,
    spacing: Any,
    bulge: Any,
    bends: Any,
    length: float,
    resistance: float,
    crowding: float,
    stiffness: float,
    held: int,
    waves: Any,
    steps: int,
    gain: float,
    tolerance: float,
) -> Any:
    weights, n = (length, resistance, crowding, stiffness, held), len(row)
    x, tried = np.zeros((n, 2)), np.zeros((n, 2))
    places, excess, slopes = np.zeros((n, 9)), np.zeros(ends.shape[1]), np.zeros((ends.shape[1], 4))
    _put(chart, row, column, spacing, x, places)
    cost = _cost(places, line, beside, ends, bulge, bends, weights, x, excess)
    for _ in range(steps):
        _slopes(places, ends, slopes)
        move = _step(slopes, line, beside, ends, bends, weights, waves, x, excess, tolerance)
        share, before = 1.0, cost
        while True:  # a step that does not help is halved
            for c in range(n):
                for k in range(2):
                    tried[c, k] = x[c, k] + share * min(max(move[c, k], -REACH), REACH)
            _put(chart, row, column, spacing, tried, places)
            cost = _cost(places, line, beside, ends, bulge, bends, weights, tried, excess)
            if cost < before:
                break
            share *= 0.5
            if share < SHORTEST:
                return x
        x, tried = tried, x
        if 1 - cost / before < gain:
            break
    return x
