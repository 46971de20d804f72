"""Wire axes on the deployed contour: braided wires woven over and under, and rings of laser-cut struts."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.ndimage import spline_filter1d
from scipy.sparse import csr_matrix

from vstent.deployment.contour import normals
from vstent.deployment.crowns import NO_CROWNS, Crowns, free_crowns
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


def draw(design: Design, size: Size, nodes_mm: Floats, wall: AbstractWall | None, crowns: Crowns = NO_CROWNS) -> Wires:
    """Draw the wires, or rings of struts, of a device on the nodes (rows, columns, 3) of its contour.

    The outer face of a wire never passes the wall, where one is given: where it would, the axis is moved to half the
    wire's depth from the wall. Free crowns over a neck or an ostium may leave the artery.
    """
    shape = grid(design, size)
    if isinstance(design, Braid):
        wires = _braid(design, size, shape, nodes_mm)
        depth_mm = np.repeat(wires.diameter_um * MM_PER_UM, np.diff(wires.starts))
        is_out = np.zeros(len(depth_mm), dtype=bool)
    else:
        assert isinstance(design, LaserCut)
        wires, is_out = _laser_cut(design, size, shape, nodes_mm, crowns)
        depth_mm = np.full(len(is_out), design.strut_thickness_um * MM_PER_UM)
    if wall is None:
        return wires
    contact, clearance_mm = wall.contact(wires.points_mm), 0.5 * depth_mm
    height_mm = np.einsum("ij,ij->i", contact.closest_mm - wires.points_mm, contact.normal)
    is_near = (contact.distance_mm < clearance_mm) | ((height_mm < 0) & (contact.distance_mm < 0.1))
    moved_mm = contact.closest_mm - clearance_mm[:, None] * contact.normal
    return wires._replace(points_mm=np.where((is_near & ~is_out)[:, None], moved_mm, wires.points_mm))


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


def _braid(design: Braid, size: Size, shape: Grid, nodes_mm: Floats) -> Wires:
    """Return the wires of a braid, those of its mesh and its strands."""
    spline, samples = _spline(nodes_mm), max(4, int(np.ceil(piece_length_mm(design, size) / POINT_SPACING_MM)))
    curves_mm: list[Floats] = []
    diameters_um: list[Floats] = []
    mesh_mm, diameter_um = _mesh(design, size, shape, spline, samples), wire_diameters_um(design)
    if design.has_closed_ends:
        curves_mm += _looped(mesh_mm, mesh_rows(design, size))
        diameters_um.append(np.full(len(curves_mm), diameter_um[0]))
    else:
        curves_mm += [*mesh_mm[0], *mesh_mm[1]]
        diameters_um.append(np.tile(diameter_um, 2))
    for strands in design.strands:
        curves_mm += list(_strands(design, size, strands, spline, samples))
        diameters_um.append(np.full(strands.count, strands.diameter_um))
    starts = np.cumsum([0, *map(len, curves_mm)]).astype(np.int32)
    return Wires(np.concatenate(curves_mm), starts, np.concatenate(diameters_um))


def _looped(hands_mm: Floats, ends: tuple[int, int]) -> list[Floats]:
    """Return wires (2, w, p, 3) of both hands as closed curves: at both ends one turns into one of the other hand."""
    # Wire k of the first hand and wire k + i of the second meet on lattice row i. A closed curve runs up the first,
    # down the second and so comes to wire k + last - first of the first hand.
    wires = hands_mm.shape[1]
    turn = (ends[1] - ends[0]) % wires
    is_left, curves_mm = np.ones(wires, dtype=bool), []
    for first in range(wires):
        parts, k = [], first
        while is_left[k]:
            is_left[k] = False
            down = (k + ends[1]) % wires
            parts += [hands_mm[0, k, :-1], hands_mm[1, down, :0:-1]]
            k = (k + turn) % wires
        if parts:
            curves_mm.append(np.concatenate([*parts, parts[0][:1]]))
    return curves_mm


def _mesh(design: Braid, size: Size, shape: Grid, spline: Floats, samples: int) -> Floats:
    """Return the axes (2, w, p, 3) of the wires of the mesh of a braid by hand, one over, one under, in mm."""
    # Wire k of the first hand passes column (2 k + row) mod n on every row, wire k of the second hand column
    # (2 k - row) mod n. All wires therefore cross on every second column. The first hand is outside on even rows,
    # the second on odd rows, so that every wire goes over and under in turn. At a crossing both axes are
    # (d1 + d2) / 4 from the contour, so that the wires just touch. Between crossings a wire changes
    # sides along a cosine.
    rows, half, ends = shape.lattice_rows, shape.lattice_columns // 2, mesh_rows(design, size)
    diameter_um = wire_diameters_um(design)
    k, row = np.meshgrid(np.arange(half), np.arange(rows), indexing="ij")
    fraction = ends[0] + np.arange((ends[1] - ends[0]) * samples + 1) / samples
    before = np.minimum(fraction.astype(int), rows - 2)
    share = 0.5 - 0.5 * np.cos(np.pi * (fraction - before))
    hands_mm = []
    for hand in (1, -1):
        partner = (k + hand * row) % half
        side = hand * (1 - 2 * (row % 2))
        height_mm = 0.25 * side * (diameter_um[k] + diameter_um[partner]) * MM_PER_UM
        if design.has_closed_ends:
            height_mm[:, list(ends)] = 0.0
        base_mm, normal = _drawn(spline, _helices(shape, hand, 0.0, 2.0, ends, samples, design.has_closed_ends))
        eased_mm = (1 - share) * height_mm[:, before] + share * height_mm[:, before + 1]
        hands_mm.append(base_mm + eased_mm.reshape(-1, 1) * normal)
    return np.reshape(hands_mm, (2, half, -1, 3))


def _strands(design: Braid, size: Size, strands: Strands, spline: Floats, samples: int) -> Floats:
    """Return the axes (w, p, 3) of strands in mm: a layer around the mesh, or beside wires of the mesh and woven."""
    shape, mesh = grid(design, size), mesh_rows(design, size)
    ends = (0, shape.lattice_rows - 1) if strands.beyond_mm else mesh
    if design.has_closed_ends and ends[1] > ends[0] + 3:
        ends = ends[0] + 1, ends[1] - 1  # strands end before the loops, which lie in the middle of the mesh
    fraction = ends[0] + np.arange((ends[1] - ends[0]) * samples + 1) / samples
    apart = 2 * design.n_wires / strands.count
    if strands.place == "outside":  # strands cross each other only, above the pores of the mesh
        first, layer_um, period, lag = 1.0, design.mesh_offset_um + strands.diameter_um, 0.5 * apart, 0.0
    else:
        # Side by side with a wire of the mesh at the free diameter; where the device is narrower, they are farther
        # apart. A strand crosses wires of the mesh by `lag` rows before its wire does.
        wire_um, free_mm = max(diameter for _, diameter in design.wires), size.free_diameter_mm
        across_mm = 0.5 * (strands.diameter_um + wire_um) * MM_PER_UM / np.cos(angle_rad(design, size, free_mm))
        first, layer_um, period = float(across_mm * design.n_columns / (np.pi * free_mm)), 0.0, 1.0
        lag = 0.5 * first
    hands_mm = []
    for hand in (1, -1):
        base_mm, normal = _drawn(spline, _helices(shape, hand, first, apart, ends, samples, False))
        woven = hand * np.cos(np.pi * (fraction + hand * lag) / period)
        height_um = layer_um + 0.5 * strands.diameter_um * woven
        hands_mm.append(base_mm + np.tile(height_um * MM_PER_UM, strands.count // 2)[:, None] * normal)
    return np.reshape(hands_mm, (strands.count, -1, 3))


@lru_cache(maxsize=16)
def _helices(
    shape: Grid, hand: int, first: float, apart: float, ends: tuple[int, int], samples: int, is_rounded: bool
) -> csr_matrix:
    """Return the samples of evenly spaced wires of one hand, whose columns increase (1) or decrease (-1) with rows.

    The first wire passes the column `first` on row 0, and the next is `apart` columns from it. They have so many
    samples from each lattice row to the next between those of `ends`, which may be rounded to half of a loop.
    """
    fraction = ends[0] + np.arange((ends[1] - ends[0]) * samples + 1) / samples
    wires = round(shape.lattice_columns / apart)
    column = first + apart * np.arange(wires)[:, None] + hand * fraction
    if is_rounded:  # to parabolas of half-width LOOP_SHARE
        from_end = np.minimum(fraction - ends[0], ends[1] - fraction)
        drawn_back = np.where(from_end < LOOP_SHARE, (LOOP_SHARE - from_end) ** 2 / (2 * LOOP_SHARE), 0.0)
        fraction = np.where(fraction - ends[0] < ends[1] - fraction, fraction + drawn_back, fraction - drawn_back)
    along = np.broadcast_to(fraction, column.shape)
    return _samples(shape, (along * shape.row_split).ravel(), (column * shape.column_split).ravel())


def _laser_cut(design: LaserCut, size: Size, shape: Grid, nodes_mm: Floats, crowns: Crowns) -> tuple[Wires, Bools]:
    """Return zigzag rings between lattice rows, each a closed polyline, and which points (p,) leave the artery."""
    # The crowns of ring j lie on row j, on the columns whose parity is that of j, and on row j + 1, where they meet
    # the crowns of ring j + 1. Crowns are rounded to parabolas. The outer face of the struts lies on the wall.
    rings, n = shape.lattice_rows - 1, shape.lattice_columns
    column = np.arange(n * POINTS_PER_STRUT + 1) / POINTS_PER_STRUT
    ring = np.arange(rings)[:, None]
    rise = _rounded_zigzag(column + ring % 2)
    k = np.minimum(column.astype(int), n - 1)
    is_low = (k + ring) % 2 == 0
    low, high = np.where([is_low, ~is_low], k, k + 1) % n  # columns (rings, p) of the crowns of every strut
    free = free_crowns(design, shape)
    if free.any():  # a free crown ends short of where it would be joined
        short = 0.5 * design.crown_gap_um * MM_PER_UM / float(row_spacing_mm(design, size, size.diameter_mm))
        begin, end = short * free[ring, low], 1 - short * free[ring + 1, high]
        rise = begin + (end - begin) * rise
    along = (ring + rise) * shape.row_split
    around = np.broadcast_to(column * shape.column_split, along.shape)
    base_mm, normal = _drawn(_spline(nodes_mm), _samples(shape, along.ravel(), around.ravel()))
    outward_mm = (design.wall_offset_um - 0.5 * design.strut_thickness_um) * MM_PER_UM
    points_mm, is_out = base_mm + outward_mm * normal, np.zeros(len(base_mm), dtype=bool)
    if crowns.shift_mm.size:
        lower_mm, upper_mm = crowns.shift_mm[1, ring, low], crowns.shift_mm[0, ring + 1, high]
        shift_mm = ((1 - rise)[..., None] * lower_mm + rise[..., None] * upper_mm).reshape(-1, 3)
        is_beside = crowns.is_over_opening[ring, low] | crowns.is_over_opening[ring + 1, high]
        is_out = is_beside.ravel() & (np.einsum("pk,pk->p", shift_mm, normal) > 0)
        points_mm = points_mm + shift_mm
    starts = np.arange(rings + 1, dtype=np.int32) * len(column)
    return Wires(points_mm, starts, np.full(rings, design.strut_width_um)), is_out


def _rounded_zigzag(x: Floats) -> Floats:
    """Return a zigzag, 0 at even and 1 at odd x, with corners rounded to parabolas of half-width CROWN_SHARE."""
    sharp = np.abs((x + 1) % 2 - 1)
    corner = np.minimum(sharp, 1 - sharp)
    rounded = np.where(corner < CROWN_SHARE, (corner**2 + CROWN_SHARE**2) / (2 * CROWN_SHARE), corner)
    zigzag = np.where(sharp > 0.5, 1 - rounded, rounded)
    return 0.5 + (zigzag - 0.5) / (1 - CROWN_SHARE)
