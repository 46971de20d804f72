"""Fast preview of a deployment, for a landing point that is moved interactively.

The wall against which a device opens does not depend on where the device is landed. It is therefore measured once, on
rays across the parent axis, up to the free diameter of the device (`Bed`). A sketch places the rows on this wall,
slides the crossings and draws the wires. Unlike `vstent.deployment.deploy.deploy`, it does not put the nodes to the
wall again after the crossings have moved, and it does not recompute the row positions from the deployed diameters.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, final

import numpy as np

from vstent.deployment import cells, pieces
from vstent.deployment.braid import FreeDiameter, Profile, expected_profile, landed_row, march, over_openings
from vstent.deployment.contour import Planes, circles, evenly_spaced, perimeters, planes
from vstent.deployment.crowns import shifts_mm
from vstent.deployment.method import check_inside, check_landing
from vstent.deployment.wall import AbstractWall, Contact
from vstent.deployment.wires import draw
from vstent.devices.design import Design, Size, widest_mm
from vstent.devices.formulas import free_diameters_mm, grid
from vstent.devices.stent import Landing, Stent
from vstent.geometry.vessel import Anatomy
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats
from vstent.units import MM_PER_UM

STEP_MM: Final = 0.2
"""Distance between the rings of rays, in mm."""
ASSUMED_BAND_MM: Final = 0.1
"""Uncertainty of a diameter, in mm, where the vessel does not come from a scan and does not state one."""


@dataclass(frozen=True, eq=False)
class Bed:
    """Wall of an artery as it limits a device of one size."""

    design: Design
    """The device."""
    size: Size
    """Its size."""
    across: Planes
    """Planes across the parent axis."""
    abscissa_mm: Floats
    """(k,) arc lengths of the rings, in mm."""
    in_plane_mm: Floats
    """(k, columns, 2) plane coordinates of the device's contour on every ring, in mm."""
    gap_mm: Floats
    """(k, columns) gap between the outer face of the device and the wall, in mm."""
    is_opening: Bools
    """(k, columns) whether a neck or an ostium lies there."""
    expected: Profile
    """Expected profile. Its curvature sets the row spacing."""
    diameter_band_mm: float
    """Uncertainty of the artery's diameters, in mm."""

    @cached_property
    def profile(self) -> Profile:
        """Diameter of the device's contour along the axis, with the curvature of the axis."""
        diameter_mm = perimeters(self.in_plane_mm) / np.pi
        return replace(self.expected, abscissa_mm=self.abscissa_mm, diameter_mm=diameter_mm)


@dataclass(frozen=True, eq=False)
class Sketch:
    """Previewed device and the uncertainty of its ends."""

    stent: Stent
    """The device."""
    gap_mm: Floats
    """(rows, columns) gap between the outer face of the device and the wall, in mm."""
    proximal_band_mm: tuple[float, float]
    """Arc lengths of the proximal end, in mm, for the smallest and the largest plausible diameters of the artery."""
    distal_band_mm: tuple[float, float]
    """Arc lengths of the distal end, in mm, for the smallest and the largest plausible diameters of the artery."""


def bed(design: Design, size: Size, anatomy: Anatomy) -> Bed:
    """Measure the wall of an artery for a device, independent of where the device is landed.

    Returns contour of the device and its gap to the wall along the whole artery.
    """
    axis, columns = anatomy.parent.axis, grid(design, size).columns
    across = planes(axis)
    abscissa_mm = np.linspace(0.0, axis.length_mm, max(8, round(axis.length_mm / STEP_MM) + 1))
    radius_mm = np.interp(abscissa_mm, axis.abscissa_mm, axis.inscribed_radius_mm)
    dd_mm = design.wall_offset_um * MM_PER_UM
    inner = circles(np.minimum(radius_mm - dd_mm, 0.5 * widest_mm(design, size)), columns)
    centers_mm, frames = across.at(abscissa_mm)
    rays = circles(np.ones(len(abscissa_mm)), columns) @ frames[:, 1:]
    origins_mm = np.repeat(centers_mm, columns, axis=0)
    reach_mm = anatomy.parent.landing_surface.first_hit(origins_mm, rays.reshape(-1, 3)).reshape(-1, columns)
    # Rays that leave through an end of the artery or run along a bend do not measure the wall.
    section_mm = np.interp(abscissa_mm, axis.abscissa_mm, anatomy.parent.section_radius_mm)[:, None]
    reach_mm = np.where(reach_mm < 1.6 * section_mm, reach_mm, section_mm)
    outer = np.maximum(reach_mm - dd_mm, 0.1)[..., None] * circles(np.ones(len(abscissa_mm)), columns)
    in_plane_mm = evenly_spaced(FreeDiameter(np.full(len(inner), widest_mm(design, size)))(inner, outer)[0])
    nodes_mm = across.place(abscissa_mm, in_plane_mm).reshape(-1, 3)
    gap_mm = np.maximum(anatomy.parent.landing_surface.closest(nodes_mm)[1] - dd_mm, 0.0).reshape(-1, columns)
    band_mm = anatomy.vessel.threshold_band_mm or ASSUMED_BAND_MM
    is_opening = over_openings(anatomy, nodes_mm).reshape(gap_mm.shape)
    expected = expected_profile(design, size, anatomy)
    return Bed(design, size, across, abscissa_mm, in_plane_mm, gap_mm, is_opening, expected, band_mm)


def sketch(wall: Bed, landing: Landing) -> Sketch:
    """Preview the device on a measured wall.

    Parameters
    ----------
    wall : wall measured for this device and size.
    landing : where the device is landed.

    Returns the device and the uncertainty of its ends.

    Raises
    ------
    LandingError
        The device would extend beyond the artery.
    """
    design, size = wall.design, wall.size
    check_landing(landing, float(wall.abscissa_mm[-1]))
    marched_mm = rows_mm = march(design, size, landing, wall.profile)
    check_inside(design, size, rows_mm, float(wall.abscissa_mm[-1]))
    flat = np.concatenate([wall.in_plane_mm, wall.gap_mm[..., None]], axis=2).reshape(len(wall.abscissa_mm), -1)
    laid = curves.interpolate(wall.abscissa_mm, flat, rows_mm).reshape(len(rows_mm), -1, 3)
    if size.free_profile_mm:
        laid = _no_wider(laid, free_diameters_mm(design, size))
    held = landed_row(design, size, landing)
    is_opening = wall.is_opening[np.abs(np.subtract.outer(rows_mm, wall.abscissa_mm)).argmin(axis=1)]
    nodes_mm = wall.across.place(rows_mm, laid[..., :2])
    slid = pieces.slide(design, size, nodes_mm, held, cells.as_drawn, is_opening)
    rows_mm = pieces.extrapolated(np.arange(len(rows_mm)), rows_mm, slid.row.mean(axis=1))
    near = np.clip(np.rint(slid.row).astype(int), 0, len(rows_mm) - 1)
    gap_mm = np.take_along_axis(laid[..., 2], near, axis=0) + np.linalg.norm(slid.lift_mm, axis=2)
    nodes_mm = slid.nodes_mm + slid.lift_mm
    wires = draw(design, size, nodes_mm, _Nothing(), slid.crowns)
    stent = Stent(design, size, nodes_mm, rows_mm, *wires, shifts_mm(slid.crowns))
    moved_mm = (rows_mm - marched_mm)[[0, -1]]
    ends_mm = [_ends_mm(wall, landing, sense * wall.diameter_band_mm) + moved_mm for sense in (-1, 1)]
    (first, last), (other_first, other_last) = (ends.tolist() for ends in ends_mm)
    return Sketch(stent, gap_mm, (first, other_first), (last, other_last))


def _ends_mm(wall: Bed, landing: Landing, wider_mm: float) -> Floats:
    """Return the proximal and distal end (2,), mm along the axis, for an artery wider by `wider_mm`."""
    diameter_mm = np.minimum(wall.profile.diameter_mm + wider_mm, widest_mm(wall.design, wall.size))
    profile = replace(wall.profile, diameter_mm=diameter_mm)
    return march(wall.design, wall.size, landing, profile)[[0, -1]]


def _no_wider(laid_mm: Floats, free_mm: Floats) -> Floats:
    """Return rows (rows, columns, 3) of plane coordinates and gaps, shrunk to their free diameters (rows,), in mm."""
    middle_mm = laid_mm[..., :2].mean(axis=1, keepdims=True)
    share = np.minimum(np.pi * free_mm / perimeters(laid_mm[..., :2]), 1.0)[:, None, None]
    moved_mm = (share - 1) * (laid_mm[..., :2] - middle_mm)
    gap_mm = laid_mm[..., 2:] + np.linalg.norm(moved_mm, axis=2, keepdims=True)
    return np.concatenate([laid_mm[..., :2] + moved_mm, gap_mm], axis=2)


@final
class _Nothing(AbstractWall):
    """Wall that is nowhere, because the contour already keeps the wires inside the artery."""

    def contact(self, points_mm: Floats) -> Contact:
        """Return an infinite distance to the wall for every point."""
        n = len(points_mm)
        return Contact(points_mm, np.full(n, np.inf), np.zeros((n, 3)), np.zeros(n, dtype=np.int32))

    def crosses(self, starts_mm: Floats, ends_mm: Floats) -> Bools:
        """Return False for every segment."""
        return np.zeros(len(starts_mm), dtype=bool)
