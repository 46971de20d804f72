"""Sketch: where a device will lie, fast enough to follow a hand that drags it; `deploy` answers in full.

The wall as the device will find it does not depend on where the device lies: it is measured once, on rays across the
parent axis, no wider than the free device (`Bed`). A sketch marches the rows over it, lets the crossings slide and
draws the wires. What it leaves out is to put every node to the wall again afterwards, and to march the rows once more.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, final

import numpy as np

from vstent.deployment import cells, pieces
from vstent.deployment.braid import FreeDiameter, Profile, expected_profile, landed_row, march
from vstent.deployment.contour import Planes, circles, evenly_spaced, perimeters, planes
from vstent.deployment.method import check_inside, check_landing
from vstent.deployment.wall import AbstractWall, Contact
from vstent.deployment.wires import Wires, draw
from vstent.devices.design import Design, Size
from vstent.devices.formulas import grid
from vstent.devices.stent import Landing, Stent
from vstent.geometry.vessel import Anatomy
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats
from vstent.units import MM_PER_UM

STEP_MM: Final = 0.2
"""Distance between the rings of rays."""
ASSUMED_BAND_MM: Final = 0.1
"""Uncertainty of a diameter where the vessel is no scan's and does not say."""


@dataclass(frozen=True, eq=False)
class Bed:
    """The wall of an artery as a device of one size finds it."""

    design: Design
    """The device."""
    size: Size
    """Its size."""
    across: Planes
    """Planes across the parent axis."""
    abscissa_mm: Floats
    """(k,) arc lengths of the rings."""
    in_plane_mm: Floats
    """(k, columns, 2) where the device's contour lies on every ring, in its plane."""
    gap_mm: Floats
    """(k, columns) clearance between the device's outer face and the wall."""
    expected: Profile
    """What its rows heed of the axis's bends."""
    diameter_band_mm: float
    """How sure the artery's diameters are."""

    @cached_property
    def profile(self) -> Profile:
        """Diameter of the device's contour along the axis."""
        diameter_mm = perimeters(self.in_plane_mm) / np.pi
        return replace(self.expected, abscissa_mm=self.abscissa_mm, diameter_mm=diameter_mm)


@dataclass(frozen=True, eq=False)
class Sketch:
    """A device where it will lie."""

    stent: Stent
    """The device."""
    gap_mm: Floats
    """(rows, columns) clearance between the device's outer face and the wall."""
    proximal_band_mm: tuple[float, float]
    """Where it begins if the artery's diameters are as small, and as large, as they may be."""
    distal_band_mm: tuple[float, float]
    """Where it ends, likewise."""


def bed(design: Design, size: Size, anatomy: Anatomy) -> Bed:
    """Measure the wall of an artery for a device."""
    axis, columns = anatomy.axis, grid(design, size).columns
    across = planes(axis)
    abscissa_mm = np.linspace(0.0, axis.length_mm, max(8, round(axis.length_mm / STEP_MM) + 1))
    radius_mm = np.interp(abscissa_mm, axis.abscissa_mm, axis.inscribed_radius_mm)
    dd_mm = design.wall_offset_um * MM_PER_UM
    inner = circles(np.minimum(radius_mm - dd_mm, 0.5 * size.free_diameter_mm), columns)
    centers_mm, frames = across.at(abscissa_mm)
    rays = circles(np.ones(len(abscissa_mm)), columns) @ frames[:, 1:]
    origins_mm = np.repeat(centers_mm, columns, axis=0)
    reach_mm = anatomy.landing_surface.first_hit(origins_mm, rays.reshape(-1, 3)).reshape(-1, columns)
    # A ray that leaves through an end of the artery, or runs along a bend, says nothing of the wall.
    section_mm = np.interp(abscissa_mm, axis.abscissa_mm, anatomy.section_radius_mm)[:, None]
    reach_mm = np.where(reach_mm < 1.6 * section_mm, reach_mm, section_mm)
    outer = np.maximum(reach_mm - dd_mm, 0.1)[..., None] * circles(np.ones(len(abscissa_mm)), columns)
    in_plane_mm = evenly_spaced(FreeDiameter(size.free_diameter_mm)(inner, outer)[0])
    nodes_mm = across.place(abscissa_mm, in_plane_mm).reshape(-1, 3)
    gap_mm = np.maximum(anatomy.landing_surface.closest(nodes_mm)[1] - dd_mm, 0.0).reshape(-1, columns)
    band_mm = anatomy.vessel.threshold_band_mm or ASSUMED_BAND_MM
    return Bed(design, size, across, abscissa_mm, in_plane_mm, gap_mm, expected_profile(design, size, anatomy), band_mm)


def sketch(wall: Bed, landing: Landing) -> Sketch:
    """Lay a device on the wall measured.

    Raises
    ------
    LandingError
        When it would leave the artery.
    """
    design, size = wall.design, wall.size
    check_landing(landing, float(wall.abscissa_mm[-1]))
    marched_mm = rows_mm = march(design, size, landing, wall.profile)
    check_inside(design, size, rows_mm, float(wall.abscissa_mm[-1]))
    flat = np.concatenate([wall.in_plane_mm, wall.gap_mm[..., None]], axis=2).reshape(len(wall.abscissa_mm), -1)
    laid = curves.interpolate(wall.abscissa_mm, flat, rows_mm).reshape(len(rows_mm), -1, 3)
    held = landed_row(design, size, landing)
    slid = pieces.slide(design, size, wall.across.place(rows_mm, laid[..., :2]), held, cells.as_drawn)
    rows_mm = pieces.extrapolated(np.arange(len(rows_mm)), rows_mm, slid.row.mean(axis=1))
    near = np.clip(np.rint(slid.row).astype(int), 0, len(rows_mm) - 1)
    gap_mm = np.take_along_axis(laid[..., 2], near, axis=0) + np.linalg.norm(slid.lift_mm, axis=2)
    nodes_mm = slid.nodes_mm + slid.lift_mm
    wires = _wires(wall, nodes_mm)
    stent = Stent(design, size, nodes_mm, rows_mm, wires.points_mm, wires.starts, wires.diameter_um)
    moved_mm = (rows_mm - marched_mm)[[0, -1]]
    ends_mm = [_ends_mm(wall, landing, sense * wall.diameter_band_mm) + moved_mm for sense in (-1, 1)]
    (first, last), (other_first, other_last) = (ends.tolist() for ends in ends_mm)
    return Sketch(stent, gap_mm, (first, other_first), (last, other_last))


def _ends_mm(wall: Bed, landing: Landing, wider_mm: float) -> Floats:
    """Return the proximal and distal end (2,), mm along the axis, for an artery wider by a given amount."""
    diameter_mm = np.minimum(wall.profile.diameter_mm + wider_mm, wall.size.free_diameter_mm)
    profile = replace(wall.profile, diameter_mm=diameter_mm)
    return march(wall.design, wall.size, landing, profile)[[0, -1]]


def _wires(wall: Bed, nodes_mm: Floats) -> Wires:
    return draw(wall.design, wall.size, nodes_mm, _Nothing())


@final
class _Nothing(AbstractWall):
    """No wall at all: the contour keeps the wires off it already."""

    def contact(self, points_mm: Floats) -> Contact:
        """Tell that every wall is infinitely far away."""
        n = len(points_mm)
        return Contact(points_mm, np.full(n, np.inf), np.zeros((n, 3)), np.zeros(n, dtype=np.int32))

    def crosses(self, starts_mm: Floats, ends_mm: Floats) -> Bools:
        """Tell that no segment crosses a wall."""
        return np.zeros(len(starts_mm), dtype=bool)
