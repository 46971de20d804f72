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

A free tip of an open cell (`vstent.deployment.crowns`) resists leaving the line of struts that leads to it, by BENDING
times the second difference of their positions. It may leave the artery where a neck or an ostium has no wall.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, diags, identity, kron, vstack
from scipy.sparse.linalg import spsolve

from vstent.deployment.contour import bilinear
from vstent.deployment.crowns import Split, around_rings
from vstent.kernels.arrays import Floats, Ints
from vstent.kernels.net import CALMING, Net

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
OUTWARD_MM: Final = 2.0
"""Largest distance by which a free crown may point out of the artery over a neck or an ostium, in mm."""
STEPS: Final = 40
"""Largest number of steps."""
GAIN: Final = 0.002
"""Relative decrease of the cost below which the iteration stops."""
INERTIA: Final = 0.03
"""Levenberg-Marquardt damping of the first step: squared weight of the moves."""
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
    weight: Floats
    """(k,) weights of their springs."""
    lowest_mm: Floats
    """(c,) smallest distance of every joint from the wall into the lumen, in mm; negative where there is no wall."""
    tips: "_Tips"
    """Free tips of open cells."""
    keeping: csc_matrix
    """(n, 3 c) matrix of the penalties that are linear in the moves."""


class _Tips(NamedTuple):
    """Free tips of open cells, which continue the line of struts that leads to them."""

    joints: Ints
    """(3, t) joint before, joint and tip."""
    outward: Floats
    """(t, 3) unit normals of the wall at the middle joints."""
    rest_mm: Floats
    """(t,) second difference of the three joints along the normal on a straight tube, in mm."""


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


def relax(
    net: Net, length_mm: float, width_mm: Floats, joint_mm: float, held: float, laid: Laid, split: Split | None = None
) -> Floats:
    """Compute the moves (joints, 3) that restore the strut lengths of a laser-cut device with the nets of `split`.

    The free device is `width_mm` (rows,) wide between neighbouring joints of a row, and a joint is `joint_mm` wide. The
    row of joints `held`, a fraction, stays in place.
    """
    frame = _frame(net, length_mm, width_mm, joint_mm, held, laid, split)
    x, inertia = np.zeros(3 * len(frame.net.line)), INERTIA
    here = _model(frame, x)
    for _ in range(STEPS):
        tried = _stepped(frame, here, x, inertia)
        there = _model(frame, tried)
        while there.cost >= here.cost and inertia < STUCK:
            inertia *= CALMING**2
            tried = _stepped(frame, here, x, inertia)
            there = _model(frame, tried)
        if there.cost >= here.cost:
            break
        gain = 1 - there.cost / here.cost
        x, here, inertia = tried, there, inertia / CALMING
        if gain < GAIN:
            break
    return x.reshape(-1, 3)


def _frame(
    net: Net, length_mm: float, width_mm: Floats, joint_mm: float, held: float, laid: Laid, split: Split | None
) -> _Frame:
    """Return the least-squares problem of a device; `split` has its free crowns, None: all crowns are joined."""
    height_mm = 2 * np.sqrt(length_mm**2 - (0.5 * width_mm) ** 2)
    if split is None:
        n, lower = len(net.line), net.gaps[0]
        pairs = np.concatenate([np.stack([np.arange(n), net.beside]), net.gaps], axis=1)
        free_mm = np.concatenate([width_mm[net.line], height_mm[net.line[lower] + 1]])
        weight, lowest_mm = np.ones(len(free_mm)), np.zeros(n)
        tips = _Tips(np.zeros((3, 0), dtype=int), np.zeros((0, 3)), np.zeros(0))
        rings, stiffness = around_rings(net.beside.astype(int)), np.full(n, BENDING)
    else:
        net, pairs, weight, rings = split.net, split.pairs, split.pair_weight, split.rings
        free_mm = np.where(split.is_width, width_mm[split.pair_line], height_mm[split.pair_line])
        lowest_mm = np.where(split.is_over_opening, -OUTWARD_MM, 0.0)
        tips = _tips(split)
        stiffness = np.where(split.is_free[rings[1]], LEVEL, BENDING)
    ring = diags(stiffness) @ _bends(rings, len(net.line))
    return _Frame(net, laid, length_mm, pairs, free_mm, joint_mm, weight, lowest_mm, tips, _keeping(net, held, ring))


def _tips(split: Split) -> _Tips:
    """Return the free tips of a device with what they are on a straight tube."""
    net, base = split.net, split.tips[1]
    points_mm = positions_mm(net, np.zeros((len(net.line), 3)), as_drawn)
    before, _, beside = around_rings(net.beside.astype(int))
    chart = net.chart[net.row[base], net.column[base]]
    outward = np.cross(chart[:, 6:], chart[:, 3:6])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    around_mm = points_mm[before[base]] - 2 * points_mm[base] + points_mm[beside[base]]
    # Neighbours on a ring are two columns away and those on a line of struts one: a quarter of the second difference.
    return _Tips(split.tips, outward, 0.25 * np.einsum("tk,tk->t", outward, around_mm))


def _stepped(frame: _Frame, here: _Model, x: Floats, inertia: float) -> Floats:
    """Return the moves (3 c,) after one damped step from moves x (3 c,), none of them outside the wall."""
    downhill = -here.slopes.T @ here.residual
    is_pressed = np.zeros(len(x), dtype=bool)  # joints on the wall that the step would push through it
    is_pressed[2::3] = (x[2::3] <= frame.lowest_mm) & (downhill[2::3] <= 0)
    free = np.flatnonzero(~is_pressed)
    slopes = here.slopes[:, free]
    tried = x.copy()
    tried[free] += spsolve(csc_matrix(slopes.T @ slopes + inertia * identity(len(free))), downhill[free])
    tried[2::3] = np.maximum(tried[2::3], frame.lowest_mm)
    return tried


def _model(frame: _Frame, x: Floats) -> _Model:
    """Return residuals and derivatives at moves x (3 c,)."""
    net, moves = frame.net, x.reshape(-1, 3)
    points_mm = positions_mm(net, moves, frame.laid)
    ways = TINY_MM * np.eye(3)
    moved_mm = [positions_mm(net, moves + way, as_drawn) - positions_mm(net, moves - way, as_drawn) for way in ways]
    change = np.stack(moved_mm, axis=1) / (2 * TINY_MM)
    strut_mm, strut_slopes = _lengths(points_mm, change, net.ends, net.bulge[net.line[net.ends[0]]])
    open_mm, open_slopes = _lengths(points_mm, change, frame.pairs, np.zeros(len(frame.free_mm)))
    ratio = open_mm / frame.free_mm
    spring = frame.weight * (0.5 * SPRINGINESS * frame.free_mm * (ratio - 1 / ratio))
    open_slopes = diags(frame.weight * (0.5 * SPRINGINESS * (1 + 1 / ratio**2))) @ open_slopes
    short_mm, short_slopes = _overlaps(frame, moves)
    tip_mm, tip_slopes = _bent(points_mm, change, frame.tips)
    residual = np.concatenate([strut_mm - frame.length_mm, spring, short_mm, frame.keeping @ x, BENDING * tip_mm])
    slopes = [strut_slopes, open_slopes, short_slopes, frame.keeping, BENDING * tip_slopes]
    return _Model(residual, csc_matrix(vstack(slopes)))


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


def _bent(points_mm: Floats, change: Floats, tips: _Tips) -> tuple[Floats, coo_matrix]:
    """Return how far tips (t,) are off the line of struts that leads to them, in mm, and the derivatives (t, 3 c)."""
    weights = np.array([1.0, -2.0, 1.0])
    ends_mm = np.einsum("i,itk->tk", weights, points_mm[tips.joints])
    off_mm = np.einsum("tk,tk->t", ends_mm, tips.outward) - tips.rest_mm
    slopes = np.einsum("i,itmk,tk->itm", weights, change[tips.joints], tips.outward)
    number = np.tile(np.repeat(np.arange(len(off_mm)), 3), 3)
    move = (3 * tips.joints.astype(int)[..., None] + np.arange(3)).ravel()
    return off_mm, coo_matrix((slopes.ravel(), (number, move)), shape=(len(off_mm), 3 * len(points_mm)))


def as_drawn(points_mm: Floats, row: Floats, column: Floats) -> Floats:
    """Return the points unchanged: a `Laid` for a chart that already lies on the wall."""
    return points_mm


def positions_mm(net: Net, moves: Floats, laid: Laid) -> Floats:
    """Return the positions (c, 3) of the joints after moves (c, 3), in mm."""
    along = net.row + moves[:, 0] / net.spacing[0]
    around = net.column + moves[:, 1] / net.spacing[1]
    found = bilinear(net.chart, along, around)
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


def _bends(triples: Ints, n: int) -> coo_matrix:
    """Return the second differences (k, n) of n joints along triples (3, k) of consecutive ones."""
    k = triples.shape[1]
    return coo_matrix((np.repeat([1.0, -2.0, 1.0], k), (np.tile(np.arange(k), 3), triples.ravel())), shape=(k, n))


def _keeping(net: Net, held: float, ring: csc_matrix) -> csc_matrix:
    """Return the matrix (k, 3 c) of the penalties on moves out of a row or around, on bending, and on the held row.

    `ring` (r, c) holds the weighted second differences around the rings.
    """
    n = len(net.line)
    member = coo_matrix((np.ones(n), (net.line, np.arange(n)))).tocsr()
    mean = diags(1 / np.bincount(net.line)) @ member
    off_row = identity(n) - member.T @ mean
    anchor = csc_matrix(np.maximum(1 - np.abs(np.arange(mean.shape[0]) - held), 0.0)) @ mean
    line = _bends(net.bends.astype(int), n)
    along, around, off = (csc_matrix(np.eye(3)[[k]]) for k in range(3))
    level = [LEVEL * kron(off_row, along), LEVEL * kron(identity(n), around), kron(anchor, along)]
    smooth = [STIFFNESS * kron(line, along), STIFFNESS * kron(line, around), BENDING * kron(line, off)]
    return csc_matrix(vstack([*level, *smooth, kron(ring, off)]))
