"""Crumpled cells: cells that are drawn shut or stand on edge, so that little of them is open to the wall.

Struts do not stretch. On the outer side of a bend, cells are drawn out along the artery and narrow around it. Where
two tight bends follow each other in different directions, as in a siphon, single cells close or turn on edge while
their neighbours open wide. Cells that are short along the artery, as on the inner side of a bend, are not crumpled:
they keep their width.
"""

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from vstent.anatomy.landing_zones import beside_neck
from vstent.anatomy.morphology import Measures
from vstent.deployment.contour import planes
from vstent.deployment.coverage import pore_places
from vstent.devices.formulas import grid
from vstent.devices.stent import Stent
from vstent.geometry.vessel import Anatomy, Centerline
from vstent.kernels import curves
from vstent.kernels.arrays import Floats

CRUMPLED_FRACTION: Final = 0.25
"""Width of a cell, relative to a straight artery, below which it is crumpled, without unit.

In a bend in one direction, with a radius of 3 mm or more, no cell of the devices tried is narrower (round artery 3.8 mm
wide, turns of 90 and 180 degrees).
"""
BENT: Final = 0.1
"""Product of curvature and diameter above which an artery has an inner and an outer side, without unit."""
OFF_AXIS: Final = 0.25
"""Distance of the middle of a row from the axis, in row diameters, from which cells are seen from that middle: the rows
of a stent that shares an artery with another one do not surround the axis."""
BESIDE: Final = 0.5
"""Largest cosine of the angle between a cell and the plane of the bend at which it is on neither side of the bend."""


class Cells(NamedTuple):
    """Cells of a device, one for every whole pore of a lattice whose crowns are all joined."""

    width_fraction: Floats
    """(k,) width seen from the axis, relative to a straight artery of the same diameter; negative if turned over."""
    abscissa_mm: Floats
    """(k,) arc length on the parent axis, in mm."""
    inward: Floats
    """(k,) cosine of the angle to the inner side of the bend: 1 on the inner side, -1 on the outer side, 0 without a
    bend."""

    @property
    def narrowest(self) -> int:
        """Number of the narrowest cell."""
        return int(self.width_fraction.argmin())

    @property
    def n_crumpled(self) -> int:
        """Number of crumpled cells."""
        return int((self.width_fraction < CRUMPLED_FRACTION).sum())


@lru_cache(maxsize=8)  # a deployment is advised on and measured
def cells(stent: Stent, axis: Centerline) -> Cells:
    """Compute how wide the cells of a device are, seen from the axis of the artery; none where no cell is whole.

    Notes
    -----
    A cell has a proximal and a distal corner, h apart, and two corners at its sides. Its vector area is A, half the
    cross product of its diagonals. With n the unit vector from the axis through its middle, the width seen from the
    axis is 2 A.n / |h|. In a straight artery of diameter D it is D sin(2 pi / N), N being the number of wires or of
    struts around. Where crowns are free, both halves of a cell have tips of their own at its sides.
    """
    shape = grid(stent.design, stent.size)
    lower_mm, upper_mm = stent.joints_mm
    row, column = pore_places(stent)
    left, right = (column - 1) % shape.lattice_columns, (column + 1) % shape.lattice_columns
    low_mm, high_mm = upper_mm[row - 1, column], lower_mm[row + 1, column]
    halves_mm = [(ring[row, left], ring[row, right]) for ring in (lower_mm, upper_mm)]
    (left_mm, right_mm), (left_above_mm, right_above_mm) = halves_mm
    up_mm = 0.5 * (left_mm + right_mm) - low_mm, high_mm - 0.5 * (left_above_mm + right_above_mm)
    area2_mm2 = np.cross(right_mm - left_mm, up_mm[0]) + np.cross(right_above_mm - left_above_mm, up_mm[1])
    middle_mm = 0.25 * (low_mm + high_mm + 0.5 * (left_mm + right_mm + left_above_mm + right_above_mm))
    abscissa_mm, across = axis.nearest_abscissa_mm(middle_mm), planes(axis)
    normal = across.at(abscissa_mm)[1][:, 0]
    off_mm = stent.nodes_mm.mean(axis=1)[:: shape.row_split][row] - axis.at(abscissa_mm)
    is_off = curves.lengths(off_mm) > OFF_AXIS * stent.row_diameter_mm[:: shape.row_split][row]
    outward = middle_mm - axis.at(abscissa_mm) - is_off[:, None] * off_mm
    outward = outward - np.einsum("kj,kj->k", outward, normal)[:, None] * normal
    outward = outward / curves.lengths(outward)[:, None]
    turning = np.gradient(across.frames[:, 0], across.abscissa_mm, axis=0)
    toward = curves.interpolate(across.abscissa_mm, turning, abscissa_mm)
    curvature_per_mm = curves.lengths(toward)
    is_bent = curvature_per_mm * float(stent.row_diameter_mm.mean()) > BENT
    inward = np.einsum("kj,kj->k", outward, toward) / np.where(is_bent, curvature_per_mm, 1.0)
    width_mm = np.einsum("kj,kj->k", area2_mm2, outward) / curves.lengths(up_mm[0] + up_mm[1])
    diameter_mm = stent.row_diameter_mm[:: shape.row_split][row]
    straight_mm = diameter_mm * np.sin(2 * np.pi / shape.lattice_columns)
    return Cells(width_mm / straight_mm, abscissa_mm, np.where(is_bent, inward, 0.0))


def crumpling_measures(anatomy: Anatomy, stent: Stent) -> Measures:
    """Return the smallest width of a cell, its place, and the number and fraction of crumpled cells; empty if none."""
    found = cells(stent, anatomy.parent.axis)
    if not len(found.width_fraction):
        return {}
    worst, inward = found.narrowest, found.inward[found.narrowest]
    measures: Measures = {
        "min_cell_width_fraction": float(found.width_fraction[worst]),
        "narrowest_cell_abscissa_mm": float(found.abscissa_mm[worst]),
        "crumpled_cells_count": float(found.n_crumpled),
        "crumpled_cells_fraction": found.n_crumpled / len(found.width_fraction),
    }
    if inward:
        measures["narrowest_cell_angle_rad"] = float(np.arccos(np.clip(inward, -1.0, 1.0)))
    return measures


def place_of_narrowest(anatomy: Anatomy, found: Cells) -> str:
    """Say where the narrowest cell lies: its distance from the nearer end of the neck, and the side of the bend."""
    inward = found.inward[found.narrowest]
    side = f", on the {'inner' if inward > 0 else 'outer'} side of the bend"
    if abs(inward) < BESIDE:
        side = ", between the inner and the outer side of the bend" if inward else ""
    return f"{beside_neck(anatomy, float(found.abscissa_mm[found.narrowest]))}{side}"
