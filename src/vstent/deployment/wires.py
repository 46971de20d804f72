"""Wire axes on the deployed contour: braided wires woven over and under, and rings of laser-cut struts."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.ndimage import spline_filter1d
from scipy.sparse import csr_matrix

from vstent.deployment.contour import normals
from vstent.deployment.wall import AbstractWall
from vstent.devices.design import Braid, Design, LaserCut, Size, piece_length_mm
from vstent.devices.formulas import Grid, grid
from vstent.kernels import curves
from vstent.kernels.arrays import Floats, Ints
from vstent.units import MM_PER_UM

POINT_SPACING_MM = 0.1
"""Largest distance between points of a braided wire's axis, in mm. There are at least four points between crossings."""
CROWN_SHARE = 0.2
"""Half-width of the rounding of a laser-cut crown, in lattice columns."""
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


def draw(design: Design, size: Size, nodes_mm: Floats, wall: AbstractWall) -> Wires:
    """Draw the wires of a device on its contour.

    The outer face of a wire never passes the wall. Where it would, the axis is moved to half the wire's depth from the
    wall.

    Parameters
    ----------
    design : Design
        The device.
    size : Size
        Its size.
    nodes_mm : (rows, columns, 3) array, mm
        Nodes of the contour.
    wall : AbstractWall
        Wall of the artery.

    Returns
    -------
    Wires
        Axes of all wires or rings of struts.
    """
    shape = grid(design, size)
    if isinstance(design, Braid):
        wires, depth_mm = _braided(design, size, shape, nodes_mm)
    else:
        wires, depth_mm = _laser_cut(design, shape, nodes_mm)
    return wires._replace(points_mm=_kept_inside(wires.points_mm, 0.5 * depth_mm, wall))


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


def _braided(design: Braid, size: Size, shape: Grid, nodes_mm: Floats) -> tuple[Wires, Floats]:
    """Return the wires of a diamond braid (one over, one under) and their diameters (p,) in mm at every point."""
    # Wire k of the first hand passes column (2 k + row) mod n on every row, wire k of the second hand column
    # (2 k - row) mod n. All wires therefore cross on every second column. The first hand is outside on even rows,
    # the second on odd rows, so that every wire goes over and under in turn. At a crossing both axes are
    # (d1 + d2) / 4 from the contour, so that the wires just touch. Between crossings a wire changes
    # sides along a cosine.
    rows, half = shape.lattice_rows, shape.lattice_columns // 2
    diameter_um = wire_diameters_um(design)
    k, row = np.meshgrid(np.arange(half), np.arange(rows), indexing="ij")
    samples = max(4, int(np.ceil(piece_length_mm(design, size) / POINT_SPACING_MM)))
    fraction = np.arange((rows - 1) * samples + 1) / samples
    spline = _spline(nodes_mm)
    points, depths = [], []
    for hand in (1, -1):
        partner = (k + hand * row) % half
        side = hand * (1 - 2 * (row % 2))
        height_mm = 0.25 * side * (diameter_um[k] + diameter_um[partner]) * MM_PER_UM
        base_mm, normal = _drawn(spline, _along_wires(shape, hand, samples))
        points.append(base_mm + _eased(height_mm, fraction).reshape(-1, 1) * normal)
        depths.append(np.repeat(diameter_um * MM_PER_UM, len(fraction)))
    starts = np.arange(2 * half + 1, dtype=np.int32) * len(fraction)
    return Wires(np.concatenate(points), starts, np.tile(diameter_um, 2)), np.concatenate(depths)


@lru_cache(maxsize=8)
def _along_wires(shape: Grid, hand: int, samples: int) -> csr_matrix:
    """Return the samples along all wires of one hand of a braid, `samples` of them from each row to the next."""
    fraction = np.arange((shape.lattice_rows - 1) * samples + 1) / samples
    column = 2 * np.arange(shape.lattice_columns // 2)[:, None] + hand * fraction
    along = np.broadcast_to(fraction, column.shape)
    return _samples(shape, (along * shape.row_split).ravel(), (column * shape.column_split).ravel())


def _eased(values: Floats, position: Floats) -> Floats:
    """Return values (w, p) at fractional rows (p,), half a cosine from each row to the next, of values (w, rows)."""
    i = np.minimum(position.astype(int), values.shape[1] - 2)
    share = 0.5 - 0.5 * np.cos(np.pi * (position - i))
    return (1 - share) * values[:, i] + share * values[:, i + 1]


def _laser_cut(design: LaserCut, shape: Grid, nodes_mm: Floats) -> tuple[Wires, Floats]:
    """Return zigzag rings between lattice rows, each a closed polyline, and their strut thickness (p,) in mm."""
    # The crowns of ring j lie on row j, on the columns whose parity is that of j, and on row j + 1, where they meet
    # the crowns of ring j + 1. Crowns are rounded to parabolas. The outer face of the struts lies on the wall.
    rings, n = shape.lattice_rows - 1, shape.lattice_columns
    column = np.arange(n * POINTS_PER_STRUT + 1) / POINTS_PER_STRUT
    ring = np.arange(rings)[:, None]
    rise = _rounded_zigzag(column + ring % 2)
    along = (ring + rise) * shape.row_split
    around = np.broadcast_to(column * shape.column_split, along.shape)
    base_mm, normal = _drawn(_spline(nodes_mm), _samples(shape, along.ravel(), around.ravel()))
    outward_mm = (design.wall_offset_um - 0.5 * design.strut_thickness_um) * MM_PER_UM
    starts = np.arange(rings + 1, dtype=np.int32) * len(column)
    width_um = np.full(rings, design.strut_width_um)
    depth_mm = np.full(len(base_mm), design.strut_thickness_um * MM_PER_UM)
    return Wires(base_mm + outward_mm * normal, starts, width_um), depth_mm


def _rounded_zigzag(x: Floats) -> Floats:
    """Return a zigzag, 0 at even and 1 at odd x, with corners rounded to parabolas of half-width CROWN_SHARE."""
    sharp = np.abs((x + 1) % 2 - 1)
    corner = np.minimum(sharp, 1 - sharp)
    rounded = np.where(corner < CROWN_SHARE, (corner**2 + CROWN_SHARE**2) / (2 * CROWN_SHARE), corner)
    zigzag = np.where(sharp > 0.5, 1 - rounded, rounded)
    return 0.5 + (zigzag - 0.5) / (1 - CROWN_SHARE)
