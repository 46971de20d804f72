"""Cells: joints of a laser-cut device move along the wall, and off it, until its struts are as long as they were cut.

Struts do not stretch: outside a bend, cells are drawn out as far as their struts reach and, where that is not enough,
leave the wall for a shorter way. Joints move along, around and off the wall until they have least

    sum over struts of (length - length as cut)^2
    +  sum over cells of (springiness times (width - free width^2 / width) / 2)^2, and the same of their heights
    +  sum over joints of (bending times the second difference of how far they and their neighbours are off the wall)^2
    +  terms that keep rows level, and what joints on a line of struts do alike,

none behind the wall. The springs open the device against the wall and keep its cells from closing; a strut is as thick
as it is wide, so cells bend off the wall about as hard as they are drawn out. Levenberg's and Marquardt's steps.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, diags, identity, kron, vstack
from scipy.sparse.linalg import spsolve

from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.kernels.net import Net

Laid = Callable[[Floats, Floats, Floats], Floats]
"""Tells where (n, 3) points of the chart, at fractional rows (n,) and columns (n,) of it, lie on the wall itself."""

SPRINGINESS: Final = 0.015
"""How much a cell that is drawn out weighs against a strut that stretches by as much."""
BENDING: Final = 0.06
"""How much joints that leave the wall otherwise than their neighbours weigh against a strut that stretches by as much.

An estimate. Without it a device in a bend of 7 mm folds up, gaps reach most of its radius; as much as a cell's spring
leaves 0.6 mm, four times as much 0.2 mm, and more than that gives gaps up for struts that stretch.
"""
LEVEL: Final = 0.01
"""How much a joint that leaves its row weighs against a strut that stretches by as much."""
STIFFNESS: Final = 0.015
"""How much a line of struts that bends otherwise on the wall weighs against a strut that stretches by as much."""
STEPS: Final = 40
"""Steps at most."""
GAIN: Final = 0.002
"""Less gained by a step, relative, ends them."""
INERTIA: Final = 0.03
"""Weight, squared, of moves in the first step."""
CALMING: Final = 3.0
"""It falls by this factor with every step that helps, and rises by its square when one does not."""
STUCK: Final = 1e3
"""With more inertia than this nothing moves any more."""
TINY_MM: Final = 0.02
"""Moves by which the chart is differentiated."""


class _Frame(NamedTuple):
    """What the joints heed, wherever they are."""

    net: Net
    """Joints and struts, on the wall."""
    laid: Laid
    """What puts them there: the chart is flat between its nodes."""
    length_mm: float
    """Length of a strut as cut."""
    pairs: Ints
    """(2, k) joints at both ends of every cell's width and height."""
    free_mm: Floats
    """(k,) how far they are apart in the free device."""
    keeping: csc_matrix
    """(n, 3 c) what is kept small besides, of the moves."""


class _Model(NamedTuple):
    """How far joints are from what they heed."""

    residual: Floats
    """(r,) what is squared and summed."""
    slopes: csc_matrix
    """(r, 3 c) its derivatives by the moves."""

    @property
    def cost(self) -> float:
        """The sum of the squares."""
        return float(self.residual @ self.residual)


def relax(net: Net, length_mm: float, width_mm: float, held: float, laid: Laid) -> Floats:
    """Moves (c, 3) of the joints along, around and off the wall, mm.

    Struts are `length_mm` long, cells of the free device `width_mm` wide; in the mean, row number `held` of the joints
    (or what lies between two rows) stays where it is. `laid` puts joints from the chart on to the wall.
    """
    pairs, free_mm = _diagonals(net, length_mm, width_mm)
    frame = _Frame(net, laid, length_mm, pairs, free_mm, _keeping(net, held))
    x, inertia = np.zeros(3 * len(net.line)), INERTIA
    here = _model(frame, x)
    for _ in range(STEPS):
        tried = _stepped(here, x, inertia)
        there = _model(frame, tried)
        while there.cost >= here.cost and inertia < STUCK:
            inertia *= CALMING**2
            tried = _stepped(here, x, inertia)
            there = _model(frame, tried)
        if there.cost >= here.cost:
            break
        gain = 1 - there.cost / here.cost
        x, here, inertia = tried, there, inertia / CALMING
        if gain < GAIN:
            break
    return x.reshape(-1, 3)


def _stepped(here: _Model, x: Floats, inertia: float) -> Floats:
    """One step from moves x (3 c,); joints on the wall stay there unless they are drawn off it."""
    downhill = -here.slopes.T @ here.residual
    free = np.flatnonzero(~_is_pressed(x, downhill))
    slopes = here.slopes[:, free]
    tried = x.copy()
    tried[free] += spsolve(csc_matrix(slopes.T @ slopes + inertia * identity(len(free))), downhill[free])
    tried[2::3] = np.maximum(tried[2::3], 0.0)
    return tried


def _is_pressed(x: Floats, downhill: Floats) -> Bools:
    """Tell which moves (3 c,) are those of joints that lie on the wall and would go behind it."""
    pressed = np.zeros(len(x), dtype=bool)
    pressed[2::3] = (x[2::3] <= 0) & (downhill[2::3] <= 0)
    return pressed


def _model(frame: _Frame, x: Floats) -> _Model:
    net, moves = frame.net, x.reshape(-1, 3)
    points_mm = _points_mm(net, moves, frame.laid)
    ways = TINY_MM * np.eye(3)
    moved_mm = [_points_mm(net, moves + way, as_drawn) - _points_mm(net, moves - way, as_drawn) for way in ways]
    change = np.stack(moved_mm, axis=1) / (2 * TINY_MM)
    strut_mm, strut_slopes = _lengths(points_mm, change, net.ends, net.bulge[net.line[net.ends[0]]])
    open_mm, open_slopes = _lengths(points_mm, change, frame.pairs, np.zeros(len(frame.free_mm)))
    ratio = open_mm / frame.free_mm
    spring = 0.5 * SPRINGINESS * frame.free_mm * (ratio - 1 / ratio)
    open_slopes = diags(0.5 * SPRINGINESS * (1 + 1 / ratio**2)) @ open_slopes
    residual = np.concatenate([strut_mm - frame.length_mm, spring, frame.keeping @ x])
    return _Model(residual, csc_matrix(vstack([strut_slopes, open_slopes, frame.keeping])))


def as_drawn(points_mm: Floats, row: Floats, column: Floats) -> Floats:
    """Leave points on the chart."""
    return points_mm


def _points_mm(net: Net, moves: Floats, laid: Laid) -> Floats:
    """Where (c, 3) the joints are."""
    rows, columns = net.chart.shape[:2]
    along = net.row + moves[:, 0] / net.spacing[0]
    around = net.column + moves[:, 1] / net.spacing[1]
    i, j = np.clip(np.floor(along).astype(int), 0, rows - 2), np.floor(around).astype(int)
    down, right = (along - i)[:, None], (around - j)[:, None]
    j, beyond = j % columns, (j + 1) % columns
    above = (1 - right) * net.chart[i, j] + right * net.chart[i, beyond]
    below = (1 - right) * net.chart[i + 1, j] + right * net.chart[i + 1, beyond]
    found = (1 - down) * above + down * below
    outward = np.cross(found[:, 6:], found[:, 3:6])
    on_wall_mm = laid(found[:, :3], along, around)
    return on_wall_mm - moves[:, 2:] * outward / np.linalg.norm(outward, axis=1, keepdims=True)


def _lengths(points_mm: Floats, change: Floats, ends: Ints, bulge_mm2: Floats) -> tuple[Floats, coo_matrix]:
    """Lengths (p,) between pairs of joints (2, p) and their derivatives (p, 3 c); `change` (c, 3 moves, 3) is theirs.

    What follows the wall is longer than its chord: squared, by the bulge (p,).
    """
    way_mm = points_mm[ends[1]] - points_mm[ends[0]]
    length_mm = np.sqrt(np.einsum("pk,pk->p", way_mm, way_mm) + bulge_mm2)
    ahead = way_mm / length_mm[:, None]
    slopes = [-np.einsum("pmk,pk->pm", change[ends[0]], ahead), np.einsum("pmk,pk->pm", change[ends[1]], ahead)]
    piece = np.tile(np.repeat(np.arange(len(length_mm)), 3), 2)
    move = (3 * ends.astype(int)[..., None] + np.arange(3)).ravel()
    shape = len(length_mm), 3 * len(points_mm)
    return length_mm, coo_matrix((np.concatenate(slopes).ravel(), (piece, move)), shape=shape)


def _diagonals(net: Net, length_mm: float, width_mm: float) -> tuple[Ints, Floats]:
    """Joints at both ends of every cell's width and height (2, k), and how far apart they are when free (k,)."""
    stride, n = net.chart.shape[1], len(net.line)
    key = net.line.astype(int) * stride + net.column
    ahead = np.searchsorted(key, key + 2 * stride)
    lower = np.flatnonzero(ahead < n)
    pairs = np.concatenate([np.stack([np.arange(n), net.beside]), np.stack([lower, ahead[lower]])], axis=1)
    height_mm = 2 * np.sqrt(length_mm**2 - (0.5 * width_mm) ** 2)
    return pairs, np.repeat([width_mm, height_mm], [n, len(lower)])


def _keeping(net: Net, held: float) -> csc_matrix:
    """Matrix (k, 3 c) of moves that are kept small: out of a row, bends, and that of the row held in the mean."""
    n, bends = len(net.line), net.bends.astype(int)
    member = coo_matrix((np.ones(n), (net.line, np.arange(n)))).tocsr()
    mean = diags(1 / np.bincount(net.line)) @ member
    off_row = identity(n) - member.T @ mean
    lines = np.arange(mean.shape[0])
    anchor = csc_matrix(np.maximum(1 - np.abs(lines - held), 0.0)) @ mean
    weights, number = np.repeat([1.0, -2.0, 1.0], bends.shape[1]), np.tile(np.arange(bends.shape[1]), 3)
    line = coo_matrix((weights, (number, bends.ravel())), shape=(bends.shape[1], n))
    beside = coo_matrix((np.ones(n), (np.arange(n), net.beside.astype(int))), shape=(n, n))
    ring = beside - 2 * identity(n) + beside.T
    along, around, off = (csc_matrix(np.eye(3)[[k]]) for k in range(3))
    level = [LEVEL * kron(off_row, along), LEVEL * kron(identity(n), around), kron(anchor, along)]
    smooth = [STIFFNESS * kron(line, along), STIFFNESS * kron(line, around), BENDING * kron(line, off)]
    return csc_matrix(vstack([*level, *smooth, BENDING * kron(ring, off)]))
