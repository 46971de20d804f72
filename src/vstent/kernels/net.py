"""A net of wire crossings that slide on a grid until the wire pieces between them have their manufactured length.

The moves x (c, 2) of the crossings, along and around in mm, minimise

    sum over pieces of (length - manufactured length)^2
    +  sum over cells of (length along the device - contact length)^2 where the cell is shorter
    +  sum over crossings of (resistance times their move relative to their row)^2
    +  sum over neighbours in a row of (crowding times the change of their distance)^2
    +  sum over neighbours on a wire of (stiffness times the second difference of their moves)^2

while the mean of one row stays in place. The steps are those of Levenberg and Marquardt, with a damping that decreases
with every successful step. Their normal equations are solved by conjugate gradients, preconditioned by the diagonal and
by a coarse problem in which whole rows move, tilt, turn and bunch.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit

from vstent.kernels.arrays import Floats, Ints

_WAVES: Final = 6
"""Number of moves of a row in the coarse problem: 1, cos, sin, along and around. Its bandwidth is two rows."""
INERTIA: Final = 0.001
"""Initial damping: squared weight of a crossing's move relative to its row.

With a damping thirty times as high, the minimisation in a small artery ended at three times the cost, because its first
steps gained too little."""
CALMING: Final = 3.0
"""Factor by which the damping decreases after a successful step; it increases by the square after a failed one."""
STUCK: Final = 10.0
"""Damping above which the minimisation ends, because nothing moves any more."""
ROUNDS: Final = 200
"""Maximum number of conjugate-gradient iterations."""


class Net(NamedTuple):
    """Crossings, and the pieces of wire from each row of crossings to the next."""

    chart: Floats
    """(rows, columns, 9) grid on which they slide: nodes, and derivatives per mm along and around."""
    row: Ints
    """(c,) grid row of every crossing before it slides."""
    column: Ints
    """(c,) grid column of every crossing before it slides."""
    line: Ints
    """(c,) row of crossings to which each belongs, ascending. This and the following index arrays are uint32, for
    speed."""
    beside: Ints
    """(c,) next crossing in the same row."""
    ends: Ints
    """(2, p) crossings at both ends of every piece, sorted by row."""
    spacing: Floats
    """(2,) grid spacing along and around, in mm."""
    bulge: Floats
    """(l,) mm2: squared length of a piece after each row minus that of its chord, because wires follow the curved
    wall."""
    bends: Ints
    """(3, b) all triples of consecutive crossings on a wire."""
    gaps: Ints
    """(2, g) crossings at the proximal and distal end of every cell, two rows apart."""


class Weights(NamedTuple):
    """Weights of the terms that are minimised."""

    length: float
    """Manufactured length of a piece."""
    resistance: float
    """Weight of a crossing's move relative to its row, compared with an equal elongation of a piece."""
    crowding: float
    """Weight of the change of distance between neighbours in a row."""
    stiffness: float
    """Weight of the change of a wire's bending."""
    held: int
    """Row of crossings whose mean position is kept."""
    contact: float
    """Length of a cell along the device at which its wires touch."""


class Descent(NamedTuple):
    """Stopping criteria of the minimisation."""

    steps: int
    """Maximum number of steps."""
    gain: float
    """Relative decrease of the cost in one step below which the minimisation ends."""
    tolerance: float
    """Relative tolerance of each least-squares problem."""


def slide(net: Net, weights: Weights, descent: Descent) -> Floats:
    """Return the moves (c, 2) of the crossings, along and around, in mm."""
    angle = 2 * np.pi * net.column / net.chart.shape[1]
    waves = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    return _slide(net, weights, waves, descent)


@njit(cache=True, nogil=True)
def _put(net: Any, x: Any, places: Any) -> None:
    """Write the chart's values (c, 9) at the crossings; beyond the first and last row it is extrapolated linearly."""
    chart = net.chart
    rows, columns = chart.shape[0], chart.shape[1]
    for c in range(len(net.row)):
        along, around = net.row[c] + x[c, 0] / net.spacing[0], net.column[c] + x[c, 1] / net.spacing[1]
        i, j = min(max(int(np.floor(along)), 0), rows - 2), int(np.floor(around))
        down, right = along - i, around - j
        j, beyond = j % columns, (j + 1) % columns
        for k in range(9):
            above = (1 - right) * chart[i, j, k] + right * chart[i, beyond, k]
            below = (1 - right) * chart[i + 1, j, k] + right * chart[i + 1, beyond, k]
            places[c, k] = (1 - down) * above + down * below


@njit(cache=True, nogil=True)
def _cost(net: Any, weights: Any, places: Any, x: Any, excess: Any) -> float:
    """Write the excess length of every piece, then of every cell that is too short (p + g,), and return the cost."""
    total = 0.0
    for p in range(net.ends.shape[1]):
        a, b = net.ends[0, p], net.ends[1, p]
        way = net.bulge[net.line[a]]
        for k in range(3):
            way += (places[b, k] - places[a, k]) ** 2
        excess[p] = np.sqrt(way) - weights.length
        total += excess[p] ** 2
    pieces = net.ends.shape[1]
    for g in range(net.gaps.shape[1]):
        a, b, way = net.gaps[0, g], net.gaps[1, g], 0.0
        for k in range(3):
            way += (places[b, k] - places[a, k]) ** 2
        excess[pieces + g] = min(0.0, np.sqrt(way) - weights.contact)
        total += excess[pieces + g] ** 2
    mean, count = _row_means(net.line, x)
    for c in range(len(net.line)):
        off = x[c, 0] - mean[net.line[c]]
        total += weights.resistance**2 * (off * off + x[c, 1] ** 2)
        total += (weights.crowding * (x[net.beside[c], 1] - x[c, 1])) ** 2
    bends = net.bends
    for b in range(bends.shape[1]):
        for k in range(2):
            total += (weights.stiffness * (x[bends[0, b], k] - 2 * x[bends[1, b], k] + x[bends[2, b], k])) ** 2
    return total + count[weights.held] * mean[weights.held] ** 2


@njit(cache=True, nogil=True)
def _row_means(line: Any, x: Any) -> tuple[Any, Any]:
    """Return the mean move along (l,) of every row of crossings, and the number of crossings in it."""
    mean, count = np.zeros(int(line[-1]) + 1), np.zeros(int(line[-1]) + 1)
    for c in range(len(line)):
        mean[line[c]] += x[c, 0]
        count[line[c]] += 1.0
    for row in range(len(mean)):
        mean[row] /= count[row]
    return mean, count


@njit(cache=True, nogil=True)
def _slopes(places: Any, ends: Any, pieces: int, excess: Any, slopes: Any) -> None:
    """Write the derivatives (p + g, 4) of every length with respect to the moves of its first and last end.

    They are zero for cells that are long enough.
    """
    for p in range(ends.shape[1]):
        if p >= pieces and excess[p] == 0.0:
            slopes[p] = 0.0
            continue
        a, b = ends[0, p], ends[1, p]
        d0, d1, d2 = places[b, 0] - places[a, 0], places[b, 1] - places[a, 1], places[b, 2] - places[a, 2]
        way = max(np.sqrt(d0 * d0 + d1 * d1 + d2 * d2), 1e-12)
        for k in range(2):
            q = 3 + 3 * k
            slopes[p, k] = -(d0 * places[a, q] + d1 * places[a, q + 1] + d2 * places[a, q + 2]) / way
            slopes[p, 2 + k] = (d0 * places[b, q] + d1 * places[b, q + 1] + d2 * places[b, q + 2]) / way


@njit(cache=True, nogil=True)
def _multiply(net: Any, weights: Any, inertia: float, ends: Any, slopes: Any, x: Any, result: Any) -> None:
    """Write the product of the normal matrix and x (c, 2)."""
    line, beside, bends = net.line, net.beside, net.bends
    mean, _ = _row_means(line, x)
    damp, crowd, stiff = weights.resistance**2, weights.crowding**2, weights.stiffness**2
    for c in range(len(line)):
        result[c, 0] = (damp + inertia) * (x[c, 0] - mean[line[c]])
        result[c, 1] = (damp + inertia) * x[c, 1]
        if line[c] == weights.held:
            result[c, 0] += mean[weights.held]
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
    for p in range(len(slopes)):
        a, b = ends[0, p], ends[1, p]
        longer = slopes[p, 0] * x[a, 0] + slopes[p, 1] * x[a, 1] + slopes[p, 2] * x[b, 0] + slopes[p, 3] * x[b, 1]
        result[a, 0] += slopes[p, 0] * longer
        result[a, 1] += slopes[p, 1] * longer
        result[b, 0] += slopes[p, 2] * longer
        result[b, 1] += slopes[p, 3] * longer


@njit(cache=True, nogil=True)
def _stretching(net: Any, slopes: Any, waves: Any) -> Any:
    """Return the pieces' part of the normal matrix on moves of whole rows: (l, 12, 12), lower, a row and the next."""
    line = net.line
    blocks = np.zeros((int(line[-1]) + 1, 2 * _WAVES, 2 * _WAVES))
    g = np.zeros(2 * _WAVES)
    for p in range(net.ends.shape[1]):
        a, b = net.ends[0, p], net.ends[1, p]
        for w in range(3):
            g[w], g[3 + w] = slopes[p, 0] * waves[a, w], slopes[p, 1] * waves[a, w]
            g[6 + w], g[9 + w] = slopes[p, 2] * waves[b, w], slopes[p, 3] * waves[b, w]
        block = blocks[line[a]]
        for i in range(2 * _WAVES):
            for j in range(i + 1):
                block[i, j] += g[i] * g[j]
    return blocks


@njit(cache=True, nogil=True)
def _coarse(net: Any, weights: Any, inertia: float, stretching: Any, waves: Any) -> Any:
    """Return the banded Cholesky factor of the normal matrix on moves of whole rows.

    Entry (i, i - k) is in place (i, k) of (n, 12); the diagonal is inverted.
    """
    line, damp, crowd = net.line, weights.resistance**2, weights.crowding**2
    blocks = stretching.copy()
    for c in range(len(line)):
        beside, block = net.beside[c], blocks[line[c]]
        for w in range(3):
            for v in range(w + 1):
                both = waves[c, w] * waves[c, v]
                apart = (waves[beside, w] - waves[c, w]) * (waves[beside, v] - waves[c, v])
                block[w, v] += (damp + inertia if w + v > 0 else 0.0) * both
                block[3 + w, 3 + v] += (damp + inertia) * both + crowd * apart
        if line[c] == weights.held:
            block[0, 0] += 1.0
    n, width = len(blocks) * _WAVES, 2 * _WAVES
    band = np.zeros((n, width))
    for row in range(len(blocks)):
        for i in range(width if row < len(blocks) - 1 else _WAVES):
            for j in range(i + 1):
                band[row * _WAVES + i, i - j] += blocks[row, i, j]
    for i in range(n):
        for k in range(min(i, width - 1), -1, -1):
            j = i - k
            total = band[i, k]
            for m in range(max(0, i - width + 1, j - width + 1), j):
                total -= band[i, i - m] * band[j, j - m]
            band[i, k] = 1 / np.sqrt(max(total, 1e-30)) if k == 0 else total * band[j, 0]
    return band


@njit(cache=True, nogil=True)
def _precondition(inverse: Any, factor: Any, line: Any, waves: Any, residual: Any, result: Any) -> None:
    """Write the product of the preconditioner and the residual (c, 2)."""
    rows = np.zeros((len(factor) // _WAVES, 2, 3))
    for c in range(len(line)):
        for k in range(2):
            for w in range(3):
                rows[line[c], k, w] += waves[c, w] * residual[c, k]
    right, width = rows.reshape(-1), factor.shape[1]
    for i in range(len(right)):
        for k in range(1, min(i, width - 1) + 1):
            right[i] -= factor[i, k] * right[i - k]
        right[i] *= factor[i, 0]
    for i in range(len(right) - 1, -1, -1):
        right[i] *= factor[i, 0]
        for k in range(1, min(i, width - 1) + 1):
            right[i - k] -= factor[i, k] * right[i]
    for c in range(len(line)):
        for k in range(2):
            result[c, k] = inverse[c, k] * residual[c, k]
            for w in range(3):
                result[c, k] += waves[c, w] * rows[line[c], k, w]


@njit(cache=True, nogil=True)
def _dot(a: Any, b: Any) -> float:
    """Return the scalar product of two arrays (c, 2)."""
    total = 0.0
    for c in range(len(a)):
        total += a[c, 0] * b[c, 0] + a[c, 1] * b[c, 1]
    return total


@njit(cache=True, nogil=True)
def _downhill(net: Any, weights: Any, ends: Any, slopes: Any, x: Any, excess: Any) -> Any:
    """Return half the negative gradient (c, 2) of the cost."""
    result = np.zeros((len(net.line), 2))
    _multiply(net, weights, 0.0, ends, slopes[:0], x, result)
    for c in range(len(result)):
        result[c, 0], result[c, 1] = -result[c, 0], -result[c, 1]
    for p in range(len(slopes)):
        for k in range(2):
            result[ends[0, p], k] -= slopes[p, k] * excess[p]
            result[ends[1, p], k] -= slopes[p, 2 + k] * excess[p]
    return result


@njit(cache=True, nogil=True)
def _step(net: Any, weights: Any, inertia: float, coarse: Any, slopes: Any, residual: Any, tolerance: float) -> Any:
    """Return the moves (c, 2) of one step, by conjugate gradients.

    `coarse` is (factor, waves) of the coarse part, `slopes` (ends, slopes) of pieces and cells.
    """
    n, (factor, waves), (ends, slopes) = len(net.line), coarse, slopes
    inverse = np.zeros((n, 2))  # of the normal matrix's diagonal
    for p in range(len(slopes)):
        for k in range(2):
            inverse[ends[0, p], k] += slopes[p, k] ** 2
            inverse[ends[1, p], k] += slopes[p, 2 + k] ** 2
    # Each crossing is on two wires and in three triples (1, -2, 1) of each: 2 (1 + 4 + 1) = 12.
    rest = weights.resistance**2 + inertia + 12 * weights.stiffness**2
    for c in range(n):
        for k in range(2):
            inverse[c, k] = 1 / (inverse[c, k] + rest + 2 * k * weights.crowding**2)
    move, way, ready, image = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 2))
    residual, goal, before = residual.copy(), 0.0, np.inf
    for _ in range(ROUNDS):
        _precondition(inverse, factor, net.line, waves, residual, ready)
        size = _dot(residual, ready)
        goal = max(goal, tolerance**2 * size)
        if size <= goal:
            break
        for c in range(n):
            for k in range(2):
                way[c, k] = ready[c, k] + size / before * way[c, k]
        _multiply(net, weights, inertia, ends, slopes, way, image)
        share, before = size / _dot(way, image), size
        for c in range(n):
            for k in range(2):
                move[c, k] += share * way[c, k]
                residual[c, k] -= share * image[c, k]
    return move


@njit(cache=True, nogil=True)
def _slide(net: Any, weights: Any, waves: Any, descent: Any) -> Any:
    """Return the moves (c, 2) that minimise the cost."""
    n, pieces = len(net.row), net.ends.shape[1]
    ends = np.concatenate((net.ends, net.gaps), axis=1)
    x, inertia = np.zeros((n, 2)), INERTIA
    places, excess, slopes = np.zeros((n, 9)), np.zeros(ends.shape[1]), np.zeros((ends.shape[1], 4))
    _put(net, x, places)
    cost = _cost(net, weights, places, x, excess)
    for _ in range(descent.steps):
        _slopes(places, ends, pieces, excess, slopes)
        residual, before = _downhill(net, weights, ends, slopes, x, excess), cost
        stretching = _stretching(net, slopes, waves)
        while True:
            coarse = _coarse(net, weights, inertia, stretching, waves), waves
            tried = x + _step(net, weights, inertia, coarse, (ends, slopes), residual, descent.tolerance)
            _put(net, tried, places)
            cost = _cost(net, weights, places, tried, excess)
            if cost < before:
                break
            inertia *= CALMING**2
            if inertia > STUCK:
                return x
        x, inertia = tried, inertia / CALMING
        if 1 - cost / before < descent.gain:
            break
    return x
