"""Move the joints of a laser-cut device so that its struts keep the length to which they were cut.

Struts do not stretch. On the outer side of a bend, the cells open along the axis as far as their struts allow. Where
that is not enough, the joints leave the wall for a shorter path. Each joint moves along, around and off the wall. The
moves minimise

    sum over struts of (length - length as cut)^2
    +  sum over cells of (SPRINGINESS (width - free width^2 / width) / 2)^2, and the same for their heights
    +  sum over joints of (BENDING times the second difference, between neighbours, of the distance from the wall)^2
    +  sum over joints of (overlap with the next joint of the row)^2
    +  penalties on moves out of a row, moves around, and unequal moves of joints on one line of struts,

with no joint outside the wall. The cell springs open the device against the wall and keep cells from closing. A strut
is as thick as it is wide, so cells resist bending off the wall about as much as they resist being drawn out. The sum is
minimised by the Levenberg-Marquardt method.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, diags, identity, kron, vstack
from scipy.sparse.linalg import spsolve

from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.kernels.net import Net

Laid = Callable[[Floats, Floats, Floats], Floats]
"""Callable that puts points on the wall: points (n, 3) in mm, rows (n,) and columns (n,) of the chart in, (n, 3) out.

Rows and columns may be fractional.
"""

SPRINGINESS: Final = 0.015
"""Weight of the change of a cell's width or height relative to an equal stretch of a strut, without unit."""
BENDING: Final = 0.06
"""Weight of a joint whose distance from the wall differs from its neighbours', relative to an equal stretch of a strut.

An estimate, without unit. In a bend of 7 mm, a device without this term folds up, and gaps reach most of its radius.
With BENDING equal to SPRINGINESS the gap is 0.6 mm, with four times that value 0.2 mm. Larger values trade gaps for
stretched struts.
"""
LEVEL: Final = 0.01
"""Weight of a joint that moves out of its row or around the device, relative to an equal stretch of a strut."""
STIFFNESS: Final = 0.015
"""Weight of the bending of a line of struts on the wall, relative to an equal stretch of a strut."""
STEPS: Final = 40
"""Largest number of steps."""
GAIN: Final = 0.002
"""Relative decrease of the cost below which the iteration stops."""
INERTIA: Final = 0.03
"""Levenberg-Marquardt damping of the first step: squared weight of the moves."""
CALMING: Final = 3.0
"""Factor that divides the damping after a successful step. A failed step multiplies the damping by its square."""
STUCK: Final = 1e3
"""Damping above which no further step is tried."""
TINY_MM: Final = 0.02
"""Step of the central differences by which joint positions are differentiated, in mm."""


class _Frame(NamedTuple):
    """Data of the least-squares problem that stay the same in every step."""

    net: Net
    """Joints and struts on the wall."""
    laid: Laid
    """Callable that puts points on the wall. It is needed because the chart is flat between its nodes."""
    length_mm: float
    """Length of a strut as cut, in mm."""
    pairs: Ints
    """(2, k) joints at both ends of the width and the height of every cell."""
    free_mm: Floats
    """(k,) distances between these joints in the free device, in mm."""
    joint_mm: float
    """Width of a joint, in mm."""
    keeping: csc_matrix
    """(n, 3 c) matrix of the penalties that are linear in the moves."""


class _Model(NamedTuple):
    """Residuals of the least-squares problem and their derivatives."""

    residual: Floats
    """(r,) residuals in mm."""
    slopes: csc_matrix
    """(r, 3 c) derivatives of the residuals with respect to the moves."""

    @property
    def cost(self) -> float:
        """Sum of the squared residuals, in mm2."""
        return float(self.residual @ self.residual)


def relax(net: Net, length_mm: float, width_mm: Floats, joint_mm: float, held: float, laid: Laid) -> Floats:
    """Compute the moves that restore the strut lengths of a laser-cut device.

    Parameters
    ----------
    net : Net
        Joints and struts on the wall, with c joints.
    length_mm : float
        Length of a strut as cut, in mm.
    width_mm : (rows,) array, mm
        Width of a cell of the free device on every row of joints.
    joint_mm : float
        Width of a joint, in mm.
    held : float
        Row of joints whose mean move along the device is held at zero. A fraction lies between two rows.
    laid : callable
        Puts points of the chart on the wall.

    Returns
    -------
    (c, 3) array, mm
        Moves of the joints along, around and off the wall (positive: into the lumen).
    """
    pairs, free_mm = _diagonals(net, length_mm, width_mm)
    frame = _Frame(net, laid, length_mm, pairs, free_mm, joint_mm, _keeping(net, held))
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
    """Return the moves (3 c,) after one damped step from moves x (3 c,), none of them outside the wall."""
    downhill = -here.slopes.T @ here.residual
    free = np.flatnonzero(~_is_pressed(x, downhill))
    slopes = here.slopes[:, free]
    tried = x.copy()
    tried[free] += spsolve(csc_matrix(slopes.T @ slopes + inertia * identity(len(free))), downhill[free])
    tried[2::3] = np.maximum(tried[2::3], 0.0)
    return tried


def _is_pressed(x: Floats, downhill: Floats) -> Bools:
    """Return which moves (3 c,) belong to joints on the wall that the step would push through it."""
    pressed = np.zeros(len(x), dtype=bool)
    pressed[2::3] = (x[2::3] <= 0) & (downhill[2::3] <= 0)
    return pressed


def _model(frame: _Frame, x: Floats) -> _Model:
    """Return residuals and derivatives at moves x (3 c,)."""
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
    short_mm, short_slopes = _overlaps(frame, moves)
    residual = np.concatenate([strut_mm - frame.length_mm, spring, short_mm, frame.keeping @ x])
    return _Model(residual, csc_matrix(vstack([strut_slopes, open_slopes, short_slopes, frame.keeping])))


def _overlaps(frame: _Frame, moves: Floats) -> tuple[Floats, coo_matrix]:
    """Return by how much neighbouring joints of a row overlap (c,), in mm and negative, and the derivatives."""
    # The distance around the device has a sign, so that a cell that is turned inside out opens again.
    net, n = frame.net, len(frame.net.line)
    beside = net.beside.astype(int)
    apart_mm = (net.column[beside] - net.column) % net.chart.shape[1] * net.spacing[1]
    short_mm = np.minimum(apart_mm + moves[beside, 1] - moves[:, 1] - frame.joint_mm, 0.0)
    near = np.flatnonzero(short_mm)
    values, places = np.repeat([1.0, -1.0], len(near)), np.concatenate([3 * beside[near] + 1, 3 * near + 1])
    return short_mm, coo_matrix((values, (np.tile(near, 2), places)), shape=(n, 3 * n))


def as_drawn(points_mm: Floats, row: Floats, column: Floats) -> Floats:
    """Return the points unchanged: a `Laid` for a chart that already lies on the wall."""
    return points_mm


def _points_mm(net: Net, moves: Floats, laid: Laid) -> Floats:
    """Return the positions (c, 3) of the joints after moves (c, 3), in mm."""
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
    """Return lengths (p,) between pairs of joints `ends` (2, p), along the wall, and their derivatives (p, 3 c)."""
    # The bulge is the squared arc along the wall minus the squared chord.
    way_mm = points_mm[ends[1]] - points_mm[ends[0]]
    length_mm = np.sqrt(np.einsum("pk,pk->p", way_mm, way_mm) + bulge_mm2)
    ahead = way_mm / length_mm[:, None]
    slopes = [-np.einsum("pmk,pk->pm", change[ends[0]], ahead), np.einsum("pmk,pk->pm", change[ends[1]], ahead)]
    piece = np.tile(np.repeat(np.arange(len(length_mm)), 3), 2)
    move = (3 * ends.astype(int)[..., None] + np.arange(3)).ravel()
    shape = len(length_mm), 3 * len(points_mm)
    return length_mm, coo_matrix((np.concatenate(slopes).ravel(), (piece, move)), shape=shape)


def _diagonals(net: Net, length_mm: float, width_mm: Floats) -> tuple[Ints, Floats]:
    """Return the joints at both ends of every cell's width and height (2, k), and their free distances (k,) in mm."""
    stride, n = net.chart.shape[1], len(net.line)
    key = net.line.astype(int) * stride + net.column
    ahead = np.searchsorted(key, key + 2 * stride)
    lower = np.flatnonzero(ahead < n)
    pairs = np.concatenate([np.stack([np.arange(n), net.beside]), np.stack([lower, ahead[lower]])], axis=1)
    height_mm = 2 * np.sqrt(length_mm**2 - (0.5 * width_mm) ** 2)
    return pairs, np.concatenate([width_mm[net.line], height_mm[net.line[lower] + 1]])


def _keeping(net: Net, held: float) -> csc_matrix:
    """Return the matrix (k, 3 c) of the penalties on moves out of a row or around, on bending, and on the held row."""
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
