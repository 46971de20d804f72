"""Elastic rods with a natural curvature, in contact with each other and with the wall of a region.

The rods are discrete (Bergou et al. 2010, ACM Trans. Graph. 29, 116): nodes `x`, and on every segment a unit normal
`frame`, the first axis of the material. All rods are in one array, one after the other; segment j leads from node j to
node j + 1 and is missing (`is_segment`) between two rods. Lengths are in mm, energies in bending stiffness per mm, so
that forces are in bending stiffness per mm2.

A step solves (drag + stiffness) dx = force with the stiffness of bending and stretch and an upper bound of that of
contact, which makes it stable at any drag: without drag it is a Newton step towards equilibrium.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit

from vstent.kernels.arrays import Floats

BAND: Final = 9
"""Columns of the band matrix: a coordinate and the eight before it, up to the node before the last."""
MOST_NEAR: Final = 32
"""Maximum number of segments near one that are looked at for contact, counted once for every pair."""
APART: Final = 2
"""Segments of one rod so many places apart are joined or too close to be in contact."""
BALANCED: Final = 0.02
"""Norm of the forces that remain over that of the contact forces, below which the rods are in balance."""
DEEP, PATIENCE = 0.15, 400
"""Depth of a contact, in diameters, at which the pushing waits, and number of steps that it does."""
ACTIVE, EVERY = 250, 10
"""Number of nodes, those that entered last, that move in every step while a rod enters; all do in one of so many."""
TIGHT: Final = 0.002
"""Relative change of length of the segment that leaves the catheter at which the pushing waits: the force, with the
stiffness of stretch, at which a coil is bent to about 1.3 wound diameters."""
SHARP, LASTING = 1.2, 10
"""Curvature times segment length at which a coil is kinked, and number of segments for which it is until that ends."""
SLACK: Final = 0.4
"""Gap, in diameters, up to which segments are listed as close."""
LARGEST_STEP: Final = 0.15
"""Largest displacement in a step, in diameters, so that no rod passes through another."""


class Rods(NamedTuple):
    """State of the rods; arrays have room for more nodes than there are."""

    x: Floats
    """(n, 3) nodes."""
    frame: Floats
    """(n, 3) unit normals of the segments."""
    natural: Floats
    """(n, 2) natural curvature at the nodes times the length of a segment, about the axes of the material."""
    is_segment: Any
    """(n,) whether a segment leads to the next node."""
    is_held: Any
    """(n,) whether the node is in the catheter."""


class Laws(NamedTuple):
    """Numbers of the rods."""

    segment: float
    """Length of a segment."""
    diameter: float
    """Distance between axes below which two rods press on each other."""
    stretch: float
    """Stretching stiffness."""
    twist: float
    """Twisting stiffness; that of bending is 1."""
    sharpest: float
    """Curvature times segment length above which bending is `HARDER`."""
    contact: float
    """Stiffness of contact."""


HARDER: Final = 100.0
"""Bending stiffness beyond the sharpest bend."""
HARDENING: Final = 3e4
"""Factor on the square of the depth of a contact, in diameters, with which it becomes harder."""


@njit(cache=True, error_model="numpy")
def _weights(u: float, size: int, value: Any, slope: Any) -> int:
    """Write the weights of a quadratic B-spline at a grid coordinate and their slopes, (3,); return their first point.

    Its gradient is continuous, so that forces at a wall can balance.
    """
    i = min(max(int(u + 0.5), 1), size - 2)
    t = min(max(u - i, -0.5), 0.5)
    value[0], value[1], value[2] = 0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2
    slope[0], slope[1], slope[2] = t - 0.5, -2 * t, t + 0.5
    return i - 1


@njit(cache=True, error_model="numpy")
def _nearest(field: Any, low: Any, spacing: float, p: Any) -> float:
    """Return the value of a field (i, j, k) at the point of its grid that is nearest to a point (3,)."""
    i = min(max(int((p[0] - low[0]) / spacing + 0.5), 0), field.shape[0] - 1)
    j = min(max(int((p[1] - low[1]) / spacing + 0.5), 0), field.shape[1] - 1)
    k = min(max(int((p[2] - low[2]) / spacing + 0.5), 0), field.shape[2] - 1)
    return field[i, j, k]


@njit(cache=True, error_model="numpy")
def _distance_at(field: Any, low: Any, spacing: float, p: Any, spline: Any, out: Any) -> float:
    """Return the value of a field (i, j, k) at a point (3,), and write its gradient to `out` (3,)."""
    i = _weights((p[0] - low[0]) / spacing, field.shape[0], spline[0], spline[1])
    j = _weights((p[1] - low[1]) / spacing, field.shape[1], spline[2], spline[3])
    k = _weights((p[2] - low[2]) / spacing, field.shape[2], spline[4], spline[5])
    value = 0.0
    out[:] = 0.0
    for a in range(3):
        for b in range(3):
            along, rise = 0.0, 0.0
            for c in range(3):
                along += spline[4, c] * field[i + a, j + b, k + c]
                rise += spline[5, c] * field[i + a, j + b, k + c]
            value += spline[0, a] * spline[2, b] * along
            out[0] += spline[1, a] * spline[2, b] * along
            out[1] += spline[0, a] * spline[3, b] * along
            out[2] += spline[0, a] * spline[2, b] * rise
    out /= spacing
    return value


@njit(cache=True, error_model="numpy")
def between_segments(p: Any, q: Any, a: Any, b: Any) -> tuple[float, float, float]:
    """Return the squared distance between segments p-q and a-b (3,), and where it is, as fractions of each.

    Ericson 2005, Real-Time Collision Detection, sec. 5.1.9.
    """
    d1x, d1y, d1z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    d2x, d2y, d2z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    rx, ry, rz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    aa = d1x * d1x + d1y * d1y + d1z * d1z
    ee = d2x * d2x + d2y * d2y + d2z * d2z
    f = d2x * rx + d2y * ry + d2z * rz
    c = d1x * rx + d1y * ry + d1z * rz
    bb = d1x * d2x + d1y * d2y + d1z * d2z
    denominator = aa * ee - bb * bb
    s = min(max((bb * f - c * ee) / denominator, 0.0), 1.0) if denominator > 1e-9 * aa * ee else 0.5
    t = (bb * s + f) / ee
    if t < 0.0:
        t, s = 0.0, min(max(-c / aa, 0.0), 1.0)
    elif t > 1.0:
        t, s = 1.0, min(max((bb - c) / aa, 0.0), 1.0)
    x, y, z = rx + s * d1x - t * d2x, ry + s * d1y - t * d2y, rz + s * d1z - t * d2z
    return x * x + y * y + z * z, s, t


@njit(cache=True, error_model="numpy")
def _list_pairs(rods: Any, first: int, n: int, laws: Any, low: Any, shape: Any, near: Any, count: Any) -> None:
    """List for the segments from `first` on the segments before them (n, `MOST_NEAR`) that are close to them."""
    close = laws.diameter * (1.0 + SLACK)
    reach = laws.segment + close
    boxes = shape[0] * shape[1] * shape[2]
    head, following = np.full(boxes, -1, np.int32), np.full(n, -1, np.int32)
    cell = np.zeros((n, 3), np.int32)
    x = rods.x
    count[first:n] = 0
    for j in range(n - 1):
        if not rods.is_segment[j] or (rods.is_held[j] and rods.is_held[j + 1]):
            continue
        for c in range(3):
            middle = 0.5 * (x[j, c] + x[j + 1, c])
            cell[j, c] = min(max(int((middle - low[c]) / reach), 0), shape[c] - 1)
        box = (cell[j, 0] * shape[1] + cell[j, 1]) * shape[2] + cell[j, 2]
        if j < first:
            following[j], head[box] = head[box], j
            continue
        for di in range(max(cell[j, 0] - 1, 0), min(cell[j, 0] + 2, shape[0])):
            for dj in range(max(cell[j, 1] - 1, 0), min(cell[j, 1] + 2, shape[1])):
                for dk in range(max(cell[j, 2] - 1, 0), min(cell[j, 2] + 2, shape[2])):
                    i = head[(di * shape[1] + dj) * shape[2] + dk]
                    while i >= 0:
                        away = 0.0
                        for c in range(3):
                            away += 0.25 * (x[j, c] + x[j + 1, c] - x[i, c] - x[i + 1, c]) ** 2
                        is_near = count[j] < MOST_NEAR and away < reach * reach
                        if is_near and between_segments(x[j], x[j + 1], x[i], x[i + 1])[0] < close * close:
                            is_apart = j - i > APART
                            for k in range(i, j):
                                if j - i > APART:
                                    break
                                is_apart = is_apart or not rods.is_segment[k]
                            if is_apart:
                                near[j, count[j]] = i
                                count[j] += 1
                        i = following[i]
        following[j], head[box] = head[box], j


@njit(cache=True, error_model="numpy")
def _add_block(matrix: Any, i: int, j: int, weight: float, d: Any) -> None:
    """Add weight d dT to the block of nodes i >= j of the band matrix."""
    for a in range(3):
        for b in range(3):
            offset = 3 * (i - j) + a - b
            if offset >= 0:
                matrix[3 * i + a, offset] += weight * d[a] * d[b]


@njit(cache=True, error_model="numpy")
def _dot(a: Any, b: Any) -> float:
    """Return the inner product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, error_model="numpy")
def _row(rows: Any, i: int) -> tuple[float, float, float]:
    """Return a row of an array (n, 3)."""
    return rows[i, 0], rows[i, 1], rows[i, 2]


@njit(cache=True, error_model="numpy")
def _cross(a: Any, b: Any) -> tuple[float, float, float]:
    """Return the cross product of two vectors (3,)."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, error_model="numpy")
def _bend(rods: Any, laws: Any, first: int, n: int, force: Any, torque: Any, matrix: Any, turn: Any) -> float:
    """Add forces and stiffness of stretch, bending and twist from the node `first` on; return the energy.

    `turn` (n, 2) becomes the stiffness against turning the frames: its diagonal, and that to the next segment.
    """
    x, frame, length = rods.x, rods.frame, laws.segment
    t0, t1, u, v = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    l0, energy = 0.0, 0.0
    for j in range(max(first - 2, 0), n - 1):
        if not rods.is_segment[j]:
            l0 = 0.0
            continue
        l1 = 0.0
        for c in range(3):
            t1[c] = x[j + 1, c] - x[j, c]
            l1 += t1[c] * t1[c]
        l1 = np.sqrt(l1)
        for c in range(3):
            t1[c] /= l1
        pull = laws.stretch * (l1 / length - 1.0)
        energy += 0.5 * pull * pull * length / laws.stretch
        for c in range(3):
            force[j, c] += pull * t1[c]
            force[j + 1, c] -= pull * t1[c]
        stiff = laws.stretch / length
        _add_block(matrix, j, j, stiff, t1)
        _add_block(matrix, j + 1, j + 1, stiff, t1)
        _add_block(matrix, j + 1, j, -stiff, t1)
        if l0 > 0.0:
            open = max(1.0 + _dot(t0, t1), 1e-3)
            cross, a, b = _cross(t0, t1), _row(frame, j - 1), _row(frame, j)
            k = 2 * cross[0] / open, 2 * cross[1] / open, 2 * cross[2] / open
            p, q = _cross(t0, a), _cross(t1, b)  # the second axes of the material
            a0, a1, b0, b1 = _dot(a, k), _dot(b, k), _dot(p, k), _dot(q, k)
            first, second = 0.5 * (b0 + b1), -0.5 * (a0 + a1)
            bend = np.sqrt(first * first + second * second)
            off0, off1 = first - rods.natural[j, 0], second - rods.natural[j, 1]
            w0, w1, stiff = off0 / length, off1 / length, 1.0
            energy += 0.5 * (off0 * off0 + off1 * off1) / length
            if bend > laws.sharpest:
                more = HARDER * (bend - laws.sharpest) / (bend * length)
                energy += 0.5 * HARDER * (bend - laws.sharpest) ** 2 / length
                w0, w1, stiff = w0 + more * first, w1 + more * second, 1.0 + HARDER
            along = _dot(a, t1) / open
            for c in range(3):
                u[c] = a[c] - along * (t0[c] + t1[c])
                v[c] = w0 * ((p[c] + q[c]) / open) - w1 * ((a[c] + b[c]) / open)
            angle = -np.arctan2(_dot(u, q), _dot(u, b))
            moment = laws.twist * angle / length
            energy += 0.5 * moment * angle
            torque[j - 1] += 0.5 * (w0 * a0 + w1 * b0) + moment
            torque[j] += 0.5 * (w0 * a1 + w1 * b1) - moment
            held = 0.5 * _dot(k, k) / length + laws.twist / length
            turn[j - 1, 0] += held
            turn[j, 0] += held
            turn[j - 1, 1] = -laws.twist / length
            m, half = (w0 * first + w1 * second) / open, 0.5 * moment
            stiff /= length**3
            across0, across1 = _cross(t1, v), _cross(t0, v)
            for c in range(3):
                g0 = (-m * (t0[c] + t1[c]) + across0[c] + half * k[c]) / l0
                g1 = (-m * (t0[c] + t1[c]) - across1[c] + half * k[c]) / l1
                force[j - 1, c] += g0
                force[j, c] += g1 - g0
                force[j + 1, c] -= g1
                matrix[3 * j - 3 + c, 0] += stiff
                matrix[3 * j + c, 0] += 4 * stiff
                matrix[3 * j + 3 + c, 0] += stiff
                matrix[3 * j + c, 3] -= 2 * stiff
                matrix[3 * j + 3 + c, 3] -= 2 * stiff
                matrix[3 * j + 3 + c, 6] += stiff
        l0 = l1
        for c in range(3):
            t0[c] = t1[c]
    return energy


@njit(cache=True, error_model="numpy")
def _pushed(deep: float, laws: Any) -> tuple[float, float, float]:
    """Return the force of a contact, its slope and its energy, for a depth: soft where they touch, hard from there."""
    hard = HARDENING * deep * deep / (laws.diameter * laws.diameter)
    stiff = laws.contact
    return stiff * deep * (1.0 + hard), stiff * (1.0 + 3.0 * hard), stiff * deep * deep * (0.5 + 0.25 * hard)


@njit(cache=True, error_model="numpy")
def _press(
    rods: Any, laws: Any, first: int, n: int, near: Any, count: Any, force: Any, matrix: Any
) -> tuple[float, float]:
    """Add forces and stiffness of the contact between rods; return the energy and the largest depth."""
    x, d, energy, deepest = rods.x, np.zeros(3), 0.0, 0.0
    for j in range(max(first - 1, 0), n - 1):
        for m in range(count[j]):
            i = near[j, m]
            squared, s, t = between_segments(x[j], x[j + 1], x[i], x[i + 1])
            if squared >= laws.diameter * laws.diameter:
                continue
            away = max(np.sqrt(squared), 1e-6)
            for c in range(3):
                d[c] = (x[j, c] + s * (x[j + 1, c] - x[j, c]) - x[i, c] - t * (x[i + 1, c] - x[i, c])) / away
            deep = laws.diameter - away
            deepest = max(deep, deepest)
            push, slope, stored = _pushed(deep, laws)
            energy += stored
            for c in range(3):
                force[j, c] += (1 - s) * push * d[c]
                force[j + 1, c] += s * push * d[c]
                force[i, c] -= (1 - t) * push * d[c]
                force[i + 1, c] -= t * push * d[c]
            twice = 2 * slope  # the other rod moves too
            _add_block(matrix, j, j, twice * (1 - s) * (1 - s), d)
            _add_block(matrix, j + 1, j + 1, twice * s * s, d)
            _add_block(matrix, j + 1, j, twice * s * (1 - s), d)
            _add_block(matrix, i, i, twice * (1 - t) * (1 - t), d)
            _add_block(matrix, i + 1, i + 1, twice * t * t, d)
            _add_block(matrix, i + 1, i, twice * t * (1 - t), d)
    return energy, deepest


@njit(cache=True, error_model="numpy")
def _contain(rods: Any, laws: Any, first: int, n: int, room: Any, force: Any, matrix: Any) -> float:
    """Add forces and stiffness of the contact with the wall; return the energy."""
    field, low, spacing = room
    x, p, d, spline, energy = rods.x, np.zeros(3), np.zeros(3), np.zeros((6, 3)), 0.0
    clear = -0.5 * laws.diameter - 2 * spacing
    for k in range(2 * first, 2 * n):
        i, t = k // 2, 0.5 * (k % 2)  # nodes and middles of segments, which are nearer to an edge
        if rods.is_held[i] or (t > 0.0 and (i == n - 1 or not rods.is_segment[i] or rods.is_held[i + 1])):
            continue
        for c in range(3):
            p[c] = x[i, c] + t * (x[i + 1, c] - x[i, c]) if t > 0.0 else x[i, c]
        if _nearest(field, low, spacing, p) < clear:
            continue
        deep = _distance_at(field, low, spacing, p, spline, d) + 0.5 * laws.diameter
        if deep > 0.0:
            push, slope, stored = _pushed(deep, laws)
            energy += stored
            for c in range(3):
                force[i, c] -= (1 - t) * push * d[c]
            _add_block(matrix, i, i, (1 - t) * (1 - t) * slope, d)
            if t > 0.0:
                for c in range(3):
                    force[i + 1, c] -= t * push * d[c]
                _add_block(matrix, i + 1, i + 1, t * t * slope, d)
                _add_block(matrix, i + 1, i, t * (1 - t) * slope, d)
    return energy


@njit(cache=True, error_model="numpy")
def _solve(matrix: Any, right: Any, start: int, rows: int) -> None:
    """Replace `right`, from row `start` on, by the solution of a symmetric band matrix, which becomes its factor."""
    for i in range(start, rows):
        first = max(start, i - BAND + 1)
        for j in range(first, i + 1):
            value = matrix[i, i - j]
            for k in range(max(first, j - BAND + 1), j):
                value -= matrix[i, i - k] * matrix[j, j - k]
            matrix[i, i - j] = value * matrix[j, 0] if j < i else 1.0 / np.sqrt(max(value, 1e-30))
        value = right[i]
        for k in range(first, i):
            value -= matrix[i, i - k] * right[k]
        right[i] = value * matrix[i, 0]
    for i in range(rows - 1, start - 1, -1):
        right[i] *= matrix[i, 0]
        for k in range(max(start, i - BAND + 1), i):
            right[k] -= matrix[i, i - k] * right[i]


@njit(cache=True, error_model="numpy")
def _move(rods: Any, first: int, n: int, shift: Any, angle: Any, most: float) -> tuple[float, float]:
    """Move nodes by (3 n,), at most by `most`, carry their frames along and turn them (n,).

    The largest moves are returned, that of the nodes that are always `ACTIVE` and that of the others.
    """
    x, frame, largest, of_others = rods.x, rods.frame, 0.0, 0.0
    old, new, m = np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(first, n):
        size = np.sqrt(shift[3 * i] ** 2 + shift[3 * i + 1] ** 2 + shift[3 * i + 2] ** 2)
        part = min(1.0, most / max(size, 1e-30))
        if i < n - ACTIVE:
            of_others = max(of_others, size * part)
        else:
            largest = max(largest, size * part)
        for c in range(3):
            shift[3 * i + c] *= part
    for j in range(max(first - 1, 0), n - 1):
        if rods.is_segment[j]:
            for c in range(3):
                old[c] = x[j + 1, c] - x[j, c]
                new[c] = old[c] + shift[3 * j + 3 + c] - shift[3 * j + c]
            size = np.sqrt(old[0] ** 2 + old[1] ** 2 + old[2] ** 2)
            for c in range(3):
                old[c] /= size
            size = np.sqrt(new[0] ** 2 + new[1] ** 2 + new[2] ** 2)
            along, cosine = 0.0, 1.0
            for c in range(3):
                new[c] /= size
                along += frame[j, c] * new[c]
                cosine += old[c] * new[c]
            for c in range(3):
                m[c] = frame[j, c] - along / max(cosine, 1e-3) * (old[c] + new[c])
            turned = min(max(angle[j], -0.3), 0.3)
            cos, sin = np.cos(turned), np.sin(turned)
            ax = cos * m[0] + sin * (new[1] * m[2] - new[2] * m[1])
            ay = cos * m[1] + sin * (new[2] * m[0] - new[0] * m[2])
            az = cos * m[2] + sin * (new[0] * m[1] - new[1] * m[0])
            along = ax * new[0] + ay * new[1] + az * new[2]
            ax, ay, az = ax - along * new[0], ay - along * new[1], az - along * new[2]
            size = np.sqrt(ax * ax + ay * ay + az * az)
            frame[j, 0], frame[j, 1], frame[j, 2] = ax / size, ay / size, az / size
    for i in range(first, n):
        for c in range(3):
            x[i, c] += shift[3 * i + c]
    return largest, of_others


@njit(cache=True, error_model="numpy")
def forces(
    rods: Any, laws: Any, first: int, n: int, room: Any, near: Any, count: Any, work: Any
) -> tuple[float, float, float]:
    """Write forces and stiffness to `work`; return energy, norm of the contact forces, and depth of the rods' worst."""
    force, torque, matrix, turn = work
    begin = max(first - 3, 0)
    force[:n], torque[begin:n], matrix[3 * begin : 3 * n], turn[begin:n] = 0.0, 0.0, 0.0, 0.0
    energy, deepest = _press(rods, laws, first, n, near, count, force, matrix)
    energy += _contain(rods, laws, first, n, room, force, matrix)
    squared = 0.0
    for i in range(first, n):
        squared += force[i, 0] ** 2 + force[i, 1] ** 2 + force[i, 2] ** 2
    return energy + _bend(rods, laws, first, n, force, torque, matrix, turn), np.sqrt(squared), deepest


@njit(cache=True, error_model="numpy")
def _step(rods: Any, laws: Any, first: int, n: int, work: Any, drag: float) -> tuple[float, float]:
    """Move all rods a step towards equilibrium from their forces and stiffness; return the moves as `_move` does."""
    force, torque, matrix, turn = work
    right = np.zeros(3 * n)
    for i in range(first, n):
        for c in range(3):
            right[3 * i + c] = 0.0 if rods.is_held[i] else force[i, c]
            matrix[3 * i + c, 0] += 1e12 if rods.is_held[i] else drag
    _solve(matrix, right, 3 * first, 3 * n)
    factor, angle = np.zeros(n), np.zeros(n)  # of the frames, by Thomas' algorithm
    for j in range(first, n):
        below = turn[j - 1, 1] if j > first else 0.0
        pivot = turn[j, 0] + 1e-3 - (below * factor[j - 1] if j > first else 0.0)
        factor[j] = turn[j, 1] / pivot
        angle[j] = (torque[j] - (below * angle[j - 1] if j > first else 0.0)) / pivot
    for j in range(n - 2, first - 1, -1):
        angle[j] -= factor[j] * angle[j + 1]
    return _move(rods, first, n, right, angle, LARGEST_STEP * laws.diameter)


@njit(cache=True, error_model="numpy")
def _free_imbalance(rods: Any, n: int, force: Any, pressed: float) -> float:
    """Return the norm of the forces on free nodes over that of the contact forces."""
    squared = 0.0
    for i in range(n):
        if not rods.is_held[i]:
            squared += force[i, 0] ** 2 + force[i, 1] ** 2 + force[i, 2] ** 2
    return np.sqrt(squared) / max(pressed, 1e-12)


@njit(cache=True, error_model="numpy")
def _strain(rods: Any, laws: Any, n: int) -> float:
    """Return the relative change of length of the segment that leaves the catheter, 0 if none does."""
    squared = 0.0
    if n < 3 or not rods.is_segment[n - 3] or rods.is_held[n - 3]:
        return 0.0
    for c in range(3):
        squared += (rods.x[n - 2, c] - rods.x[n - 3, c]) ** 2
    return abs(np.sqrt(squared) / laws.segment - 1.0)


@njit(cache=True, error_model="numpy")
def _sharpest(rods: Any, first: int, n: int) -> float:
    """Return the largest curvature times segment length of the nodes from `first` on."""
    sharpest = 0.0
    for j in range(first + 1, n - 1):
        if not (rods.is_segment[j - 1] and rods.is_segment[j]):
            continue
        along, before, after = 0.0, 0.0, 0.0
        for c in range(3):
            a, b = rods.x[j, c] - rods.x[j - 1, c], rods.x[j + 1, c] - rods.x[j, c]
            along, before, after = along + a * b, before + a * a, after + b * b
        cosine = min(max(along / np.sqrt(before * after), -0.999), 1.0)
        sharpest = max(sharpest, 2 * np.sqrt((1 - cosine) / (1 + cosine)))
    return sharpest


@njit(cache=True, error_model="numpy")
def _feed(rods: Any, laws: Any, n: int, push: Any, part: int, steps: int) -> int:
    """Advance the nodes in the catheter by a part of a segment, with a new node for the first; return how many are."""
    if part == 0:
        for c in range(3):
            rods.x[n, c] = rods.x[n - 1, c] - laws.segment * push[c]
            rods.frame[n - 1, c] = rods.frame[n - 2, c]
        rods.is_segment[n - 1], rods.is_held[n] = True, True
        n += 1
    for i in range(n - 3, n):
        if rods.is_held[i]:
            for c in range(3):
                rods.x[i, c] += laws.segment / steps * push[c]
    rods.is_held[n - 3] = False
    return n


@njit(cache=True, error_model="numpy", nogil=True)
def advance(rods: Any, laws: Any, n: int, room: Any, drag: float, steps: int, push: Any, entering: int) -> Any:
    """Push nodes out of a catheter while all rods move, and return the number of nodes.

    The last two nodes are held in the catheter, the last but one at its tip; `push` (3,) is its direction. Each of the
    `entering` nodes advances by a segment in so many `steps`, and waits where a contact is `DEEP` or the segment is
    `TIGHT`. It ends where that, or a kink, lasts. With none entering, the rods move towards equilibrium, at most
    `steps` times, until they are `BALANCED`. Also returned are the imbalance of the forces and the largest depth of a
    contact at any time.
    """
    field, low, spacing = room
    size = len(rods.x)
    shape = np.zeros(3, np.int64)
    for c in range(3):
        shape[c] = int(field.shape[c] * spacing / (laws.segment + laws.diameter * (1.0 + SLACK))) + 1
    near, count = np.zeros((size, MOST_NEAR), np.int32), np.zeros(size, np.int32)
    work = np.zeros((size, 3)), np.zeros(size), np.zeros((3 * size, BAND)), np.zeros((size, 2))
    x, frame = rods.x.copy(), rods.frame.copy()
    least = drag
    moved, of_others, before, imbalance, worst, waited, done = np.inf, np.inf, np.inf, np.inf, 0.0, 0, 0
    ticks, kinked = 0, 0
    while done < steps * max(entering, 1) and waited < PATIENCE and kinked < LASTING:
        if moved + of_others > 0.5 * SLACK * laws.diameter:
            start = 0 if of_others > 0.25 * SLACK * laws.diameter else max(n - ACTIVE - 1, 0)
            _list_pairs(rods, start, n, laws, low, shape, near, count)
            moved, of_others = 0.0, of_others if start else 0.0
        first = max(0, n - ACTIVE) if entering > 0 and ticks % EVERY else 0
        energy, pressed, deepest = forces(rods, laws, first, n, room, near, count, work)
        if entering == 0 and energy > before and drag < 1e4:
            rods.x[:n], rods.frame[:n], drag, before = x[:n], frame[:n], 4.0 * drag, np.inf
            of_others, done = np.inf, done + 1
            continue
        imbalance, worst = _free_imbalance(rods, n, work[0], pressed), max(worst, deepest)
        if entering == 0:
            if imbalance < BALANCED:
                break
            x[:n], frame[:n], before, drag, done = rods.x[:n], rods.frame[:n], energy, max(0.8 * drag, least), done + 1
        moves = _step(rods, laws, first, n, work, drag)
        moved, of_others = moved + moves[0], of_others + moves[1]
        if entering > 0:
            waited, ticks = waited + 1, ticks + 1
            if deepest < DEEP * laws.diameter and _strain(rods, laws, n) < TIGHT:
                if done % steps == 0:
                    kinked = kinked + 1 if _sharpest(rods, max(0, n - ACTIVE), n - 2) > SHARP else 0
                n = _feed(rods, laws, n, push, done % steps, steps)
                moved = np.inf if done % steps == 0 else moved + laws.segment / steps
                done, waited = done + 1, 0
    return n, imbalance, worst
