"""Wire axes on the deployed contour: braided wires woven over and under, and rings of laser-cut struts."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.ndimage import spline_filter1d
from scipy.sparse import csr_matrix

from vstent.deployment.contour import normals
from vstent.deployment.crowns import Crowns, free_crowns
from vstent.deployment.wall import AbstractWall
from vstent.devices.design import Braid, Design, LaserCut, Size, Strands, angle_rad, piece_length_mm
from vstent.devices.formulas import Grid, grid, mesh_rows, row_spacing_mm
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.units import MM_PER_UM

POINT_SPACING_MM = 0.1
"""Largest distance between points of a braided wire's axis, in mm. There are at least four points between crossings."""
CROWN_SHARE = 0.2
"""Half-width of the rounding of a laser-cut crown, in lattice columns."""
LOOP_SHARE = 0.5
"""Half-width of the loop in which a wire turns back at a closed end of a braid, in lattice columns."""
POINTS_PER_STRUT = 16
"""Points on a laser-cut strut, crowns included."""
PAD = 8
"""Rows and columns by which the contour is continued, so that its spline is not affected by the rim."""


class Wires(NamedTuple):
    """Axes of all wires of a device."""

    points_mm: Floats
    """(p, 3) points, in mm, one polyline after another."""
    starts: Ints
    """(w + 1,) first point of every polyline, followed by p."""
    diameter_um: Floats
    """(w,) wire diameter or strut width of every polyline, in um."""


def draw(design: Design, size: Size, nodes_mm: Floats, wall: AbstractWall, crowns: Crowns | None = None) -> Wires:
    """Draw the wires of a device on its contour.

    The outer face of a wire never passes the wall. Where it would, the axis is moved to half the wire's depth from the
    wall. Free crowns over a neck or an ostium may leave the artery.

    Parameters
    ----------
    nodes_mm : (rows, columns, 3), mm; nodes of the contour.
    wall : wall of the artery.
    crowns : free crowns of an open-cell device; None: they lie where they would be joined.

    Returns axes of all wires or rings of struts.
    """
    shape = grid(design, size)
    if isinstance(design, Braid):
        wires, depth_mm = _braid(design, size, shape, nodes_mm)
        return wires._replace(points_mm=_kept_inside(wires.points_mm, 0.5 * depth_mm, wall))
    wires, is_out = _laser_cut(design, size, shape, nodes_mm, crowns)
    clearance_mm = np.full(len(is_out), 0.5 * design.strut_thickness_um * MM_PER_UM)
    kept_mm = _kept_inside(wires.points_mm, clearance_mm, wall)
    return wires._replace(points_mm=np.where(is_out[:, None], wires.points_mm, kept_mm))


def _kept_inside(points_mm: Floats, clearance_mm: Floats, wall: AbstractWall) -> Floats:
    """Return points (p, 3) moved to at least `clearance_mm` (p,) from the wall, inside the lumen."""
    contact = wall.contact(points_mm)
    height_mm = np.einsum("ij,ij->i", contact.closest_mm - points_mm, contact.normal)
    is_near = (contact.distance_mm < clearance_mm) | ((height_mm < 0) & (contact.distance_mm < 0.1))
    moved = contact.closest_mm - clearance_mm[:, None] * contact.normal
    return np.where(is_near[:, None], moved, points_mm)


def _samples(shape: Grid, row: Floats, column: Floats) -> csr_matrix:
    """Return weights (n, k) of a contour's k spline coefficients at fractional rows and columns (n,) of its grid."""
    pad = min(PAD, shape.rows - 1)
    height, width = shape.rows + 2 * pad, shape.columns + 2 * PAD
    (i, down), (j, right) = _knots(row + pad, height), _knots(column % shape.columns + PAD, width)
    values = (down[:, :, None] * right[:, None]).ravel()
    places = (i[:, :, None] * width + j[:, None]).ravel().astype(np.int32)
    first = np.arange(0, len(values) + 1, 16, dtype=np.int32)
    return csr_matrix((values, places, first), shape=(len(row), height * width))


def _knots(where: Floats, n: int) -> tuple[Ints, Floats]:
    """Return the four of n knots (m, 4) around each place (m,), and the weights (m, 4) of cubic B-splines there."""
    first = np.floor(where).astype(int)
    t = where - first
    weights = [(1 - t) ** 3, (3 * t - 6) * t**2 + 4, ((3 - 3 * t) * t + 3) * t + 1, t**3]
    return np.clip(first[:, None] + np.arange(-1, 3), 0, n - 1), np.stack(weights, axis=1) / 6


def _spline(nodes_mm: Floats) -> Floats:
    """Return cubic spline coefficients (k, 6) of a contour (rows, columns, 3) and its normals, columns periodic."""
    values, pad = np.concatenate([nodes_mm, normals(nodes_mm)], axis=2), min(PAD, len(nodes_mm) - 1)
    before = 2 * values[:1] - values[pad:0:-1]
    after = 2 * values[-1:] - values[-2 : -pad - 2 : -1]
    values = np.concatenate([before, values, after])
    values = np.concatenate([values[:, -PAD:], values, values[:, :PAD]], axis=1)
    for axis in (0, 1):
        values = spline_filter1d(values, order=3, axis=axis, mode="mirror")
    return values.reshape(-1, 6)


def _drawn(spline: Floats, samples: csr_matrix) -> tuple[Floats, Floats]:
    """Return points (n, 3) and outward unit normals (n, 3) of a contour's spline (k, 6) at samples (n, k)."""
    found = samples @ spline
    return found[:, :3], found[:, 3:] / curves.lengths(found[:, 3:])[:, None]


def wire_diameters_um(design: Braid) -> Floats:
    """Return the diameters (n/2,), in um, of the wires of one hand, each group spread evenly around the device."""
    places = [((i + 0.5) / (count / 2), diameter) for count, diameter in design.wires for i in range(count // 2)]
    return np.array([diameter for _, diameter in sorted(places)])


class _Braided(NamedTuple):
    """Wires of both hands of one layer of a braid, before loops join them at closed ends."""

    points_mm: Floats
    """(2, w, p, 3) axes: of the hand that turns with increasing columns, and of the other one."""
    diameter_um: Floats
    """(w,) diameters of the wires of one hand, in um."""


def _braid(design: Braid, size: Size, shape: Grid, nodes_mm: Floats) -> tuple[Wires, Floats]:
    """Return the wires of a braid, mesh and strands, and their diameters (p,) in mm at every point."""
    spline, samples = _spline(nodes_mm), max(4, int(np.ceil(piece_length_mm(design, size) / POINT_SPACING_MM)))
    mesh = _mesh(design, size, shape, spline, samples)
    wires = [_looped(mesh, mesh_rows(design, size)) if design.has_closed_ends else _open(mesh)]
    wires += [_open(_strands(design, size, strands, spline, samples)) for strands in design.strands]
    counts = np.concatenate([np.diff(one.starts) for one in wires])
    diameter_um = np.concatenate([one.diameter_um for one in wires])
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    depth_mm = np.repeat(diameter_um * MM_PER_UM, counts)
    return Wires(np.concatenate([one.points_mm for one in wires]), starts, diameter_um), depth_mm


def _open(layer: _Braided) -> Wires:
    """Return the wires of a layer whose ends are open."""
    hands, wires, points = layer.points_mm.shape[:3]
    starts = np.arange(hands * wires + 1, dtype=np.int32) * points
    return Wires(layer.points_mm.reshape(-1, 3), starts, np.tile(layer.diameter_um, hands))


def _looped(layer: _Braided, ends: tuple[int, int]) -> Wires:
    """Return the wires of a layer as closed curves: at both ends, a wire of one hand turns into one of the other."""
    # Wire k of the first hand and wire k + i of the second meet on lattice row i. A closed curve runs up the first,
    # down the second and so comes to wire k + last - first of the first hand.
    wires = layer.points_mm.shape[1]
    turn = (ends[1] - ends[0]) % wires
    is_left, curves_mm = np.ones(wires, dtype=bool), []
    for first in range(wires):
        parts, k = [], first
        while is_left[k]:
            is_left[k] = False
            down = (k + ends[1]) % wires
            parts += [layer.points_mm[0, k, :-1], layer.points_mm[1, down, :0:-1]]
            k = (k + turn) % wires
        if parts:
            curves_mm.append(np.concatenate([*parts, parts[0][:1]]))
    starts = np.cumsum([0, *map(len, curves_mm)]).astype(np.int32)
    return Wires(np.concatenate(curves_mm), starts, np.full(len(curves_mm), layer.diameter_um[0]))


def _mesh(design: Braid, size: Size, shape: Grid, spline: Floats, samples: int) -> _Braided:
    """Return the wires of the mesh of a braid, one over, one under."""
    # Wire k of the first hand passes column (2 k + row) mod n on every row, wire k of the second hand column
    # (2 k - row) mod n. All wires therefore cross on every second column. The first hand is outside on even rows,
    # the second on odd rows, so that every wire goes over and under in turn. At a crossing both axes are
    # (d1 + d2) / 4 from the contour, so that the wires just touch. Between crossings a wire changes
    # sides along a cosine.
    rows, half = shape.lattice_rows, shape.lattice_columns // 2
    ends = mesh_rows(design, size)
    diameter_um = wire_diameters_um(design)
    k, row = np.meshgrid(np.arange(half), np.arange(rows), indexing="ij")
    fraction = ends[0] + np.arange((ends[1] - ends[0]) * samples + 1) / samples
    hands = []
    for hand in (1, -1):
        partner = (k + hand * row) % half
        side = hand * (1 - 2 * (row % 2))
        height_mm = 0.25 * side * (diameter_um[k] + diameter_um[partner]) * MM_PER_UM
        if design.has_closed_ends:
            height_mm[:, list(ends)] = 0.0
        along = _Helices(hand, 0.0, 2.0, ends, samples, design.has_closed_ends)
        base_mm, normal = _drawn(spline, _along_wires(shape, along))
        hands.append(base_mm + _eased(height_mm, fraction).reshape(-1, 1) * normal)
    return _Braided(np.reshape(hands, (2, half, -1, 3)), diameter_um)


def _strands(design: Braid, size: Size, strands: Strands, spline: Floats, samples: int) -> _Braided:
    """Return strands of a braid: a layer around the mesh, or beside wires of the mesh and woven with them."""
    shape = grid(design, size)
    ends = (0, shape.lattice_rows - 1) if strands.beyond_mm else mesh_rows(design, size)
    if (
        design.has_closed_ends and ends[1] > ends[0] + 3
    ):  # strands end before the loops, which lie in the middle of the mesh
        ends = ends[0] + 1, ends[1] - 1
    fraction = ends[0] + np.arange((ends[1] - ends[0]) * samples + 1) / samples
    apart = 2 * design.n_wires / strands.count
    shift, layer_um, period = _between(design, size, strands, apart)
    lag = 0.5 * shift if strands.place == "beside" else 0.0  # it crosses wires of the mesh so much before they cross
    hands = []
    for hand in (1, -1):
        along = _Helices(hand, shift, apart, ends, samples, False)
        base_mm, normal = _drawn(spline, _along_wires(shape, along))
        woven = hand * np.cos(np.pi * (fraction + hand * lag) / period)
        height_um = layer_um + 0.5 * strands.diameter_um * woven
        hands.append(base_mm + np.tile(height_um * MM_PER_UM, strands.count // 2)[:, None] * normal)
    half = strands.count // 2
    return _Braided(np.reshape(hands, (2, half, -1, 3)), np.full(half, strands.diameter_um))


def _between(design: Braid, size: Size, strands: Strands, apart: float) -> tuple[float, float, float]:
    """Return the column of the first strand, the height of its layer in um, and the rows between its crossings."""
    if strands.place == "outside":  # strands cross each other only, above the pores of the mesh
        return 1.0, design.mesh_offset_um + strands.diameter_um, 0.5 * apart
    # Side by side with a wire of the mesh at the free diameter; where the device is narrower, they are farther apart.
    wire_um, free_mm = max(diameter for _, diameter in design.wires), size.free_diameter_mm
    across_mm = 0.5 * (strands.diameter_um + wire_um) * MM_PER_UM / np.cos(angle_rad(design, size, free_mm))
    return float(across_mm * design.n_columns / (np.pi * free_mm)), 0.0, 1.0


class _Helices(NamedTuple):
    """Evenly spaced wires of one hand on the lattice, and their samples."""

    hand: int
    """1: columns increase with rows. -1: they decrease."""
    first: float
    """Column of the first wire on row 0."""
    apart: float
    """Columns between wires."""
    ends: tuple[int, int]
    """First and last lattice row."""
    samples: int
    """Samples from each row to the next."""
    is_rounded: bool
    """Whether the ends are rounded to half of a loop."""


@lru_cache(maxsize=16)
def _along_wires(shape: Grid, helices: _Helices) -> csr_matrix:
    """Return the samples along all wires of one hand of a layer of a braid."""
    hand, first, apart, ends, samples, is_rounded = helices
    fraction = ends[0] + np.arange((ends[1] - ends[0]) * samples + 1) / samples
    wires = round(shape.lattice_columns / apart)
    column = first + apart * np.arange(wires)[:, None] + hand * fraction
    along = np.broadcast_to(_with_loops(fraction, ends) if is_rounded else fraction, column.shape)
    return _samples(shape, (along * shape.row_split).ravel(), (column * shape.column_split).ravel())


def _with_loops(fraction: Floats, ends: tuple[int, int]) -> Floats:
    """Return the rows of samples whose ends are rounded to parabolas of half-width LOOP_SHARE."""
    from_end = np.minimum(fraction - ends[0], ends[1] - fraction)
    drawn_back = np.where(from_end < LOOP_SHARE, (LOOP_SHARE - from_end) ** 2 / (2 * LOOP_SHARE), 0.0)
    return np.where(fraction - ends[0] < ends[1] - fraction, fraction + drawn_back, fraction - drawn_back)


def _eased(values: Floats, position: Floats) -> Floats:
    """Return values (w, p) at fractional rows (p,), half a cosine from each row to the next, of values (w, rows)."""
    i = np.minimum(position.astype(int), values.shape[1] - 2)
    share = 0.5 - 0.5 * np.cos(np.pi * (position - i))
    return (1 - share) * values[:, i] + share * values[:, i + 1]


def _laser_cut(
    design: LaserCut, size: Size, shape: Grid, nodes_mm: Floats, crowns: Crowns | None
) -> tuple[Wires, Bools]:
    """Return zigzag rings between lattice rows, each a closed polyline, and which points (p,) leave the artery."""
    # The crowns of ring j lie on row j, on the columns whose parity is that of j, and on row j + 1, where they meet
    # the crowns of ring j + 1. Crowns are rounded to parabolas. The outer face of the struts lies on the wall.
    rings, n = shape.lattice_rows - 1, shape.lattice_columns
    column = np.arange(n * POINTS_PER_STRUT + 1) / POINTS_PER_STRUT
    ring = np.arange(rings)[:, None]
    rise = _rounded_zigzag(column + ring % 2)
    strut = _struts(shape, column)
    free = free_crowns(design, shape)
    if free.any():  # a free crown ends short of where it would be joined
        short = 0.5 * design.crown_gap_um * MM_PER_UM / float(row_spacing_mm(design, size, size.diameter_mm))
        low, high = short * free[ring, strut[0]], 1 - short * free[ring + 1, strut[1]]
        rise = low + (high - low) * rise
    along = (ring + rise) * shape.row_split
    around = np.broadcast_to(column * shape.column_split, along.shape)
    base_mm, normal = _drawn(_spline(nodes_mm), _samples(shape, along.ravel(), around.ravel()))
    outward_mm = (design.wall_offset_um - 0.5 * design.strut_thickness_um) * MM_PER_UM
    points_mm, is_out = base_mm + outward_mm * normal, np.zeros(len(base_mm), dtype=bool)
    if crowns is not None:
        shift_mm, is_out = _shifted(crowns, ring, strut, rise, normal)
        points_mm = points_mm + shift_mm
    starts = np.arange(rings + 1, dtype=np.int32) * len(column)
    return Wires(points_mm, starts, np.full(rings, design.strut_width_um)), is_out


def _struts(shape: Grid, column: Floats) -> Ints:
    """Return the columns (2, rings, p) of the lower and the upper crown of the strut at columns (p,) of every ring."""
    k = np.minimum(column.astype(int), shape.lattice_columns - 1)
    is_low = (k + np.arange(shape.lattice_rows - 1)[:, None]) % 2 == 0
    return np.where([is_low, ~is_low], k, k + 1) % shape.lattice_columns


def _shifted(crowns: Crowns, ring: Ints, strut: Ints, rise: Floats, normal: Floats) -> tuple[Floats, Bools]:
    """Return the displacement (p, 3) of points on struts with free crowns, and which points leave the artery (p,)."""
    lower_mm, upper_mm = crowns.shift_mm[1, ring, strut[0]], crowns.shift_mm[0, ring + 1, strut[1]]
    shift_mm = ((1 - rise)[..., None] * lower_mm + rise[..., None] * upper_mm).reshape(-1, 3)
    is_beside = crowns.is_over_opening[ring, strut[0]] | crowns.is_over_opening[ring + 1, strut[1]]
    return shift_mm, is_beside.ravel() & (np.einsum("pk,pk->p", shift_mm, normal) > 0)


def _rounded_zigzag(x: Floats) -> Floats:
    """Return a zigzag, 0 at even and 1 at odd x, with corners rounded to parabolas of half-width CROWN_SHARE."""
    sharp = np.abs((x + 1) % 2 - 1)
    corner = np.minimum(sharp, 1 - sharp)
    rounded = np.where(corner < CROWN_SHARE, (corner**2 + CROWN_SHARE**2) / (2 * CROWN_SHARE), corner)
    zigzag = np.where(sharp > 0.5, 1 - rounded, rounded)
    return 0.5 + (zigzag - 0.5) / (1 - CROWN_SHARE)
