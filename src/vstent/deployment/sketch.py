"""Fast preview of a deployment, for a landing point that is moved interactively.

The wall against which a device opens does not depend on where the device is landed. It is therefore measured once, on
rays across the parent axis, up to the free diameter of the device (`MeasuredWall`). A sketch places the rows on it,
slides the crossings and draws the wires. Unlike `vstent.deployment.deploy.deploy`, it does not put the nodes to the
wall again after the crossings have moved, and it does not recompute the row positions from the deployed diameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from vstent.deployment import cells, pieces
from vstent.deployment.braid import Profile, expected_profile, grown, landed_row, march, over_openings
from vstent.deployment.contour import Planes, circles, evenly_spaced, perimeters, planes
from vstent.deployment.method import check_inside, check_landing
from vstent.deployment.wall import landing_wall
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
class MeasuredWall:
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
    wall_gap_mm: Floats
    """(rows, columns) gap between the outer face of the device and the wall, in mm."""
    proximal_band_mm: tuple[float, float]
    """Arc lengths of the proximal end, in mm, for the smallest and the largest plausible diameters of the artery."""
    distal_band_mm: tuple[float, float]
    """Arc lengths of the distal end, in mm, for the smallest and the largest plausible diameters of the artery."""


def measured_wall(design: Design, size: Size, anatomy: Anatomy, inside: Sequence[Stent] = ()) -> MeasuredWall:
    """Measure the wall of an artery for a device, independent of where the device is landed.

    Where devices are already in the artery, it is the inner face of the last of them.
    """
    surface = landing_wall(anatomy, inside)[0].surface
    axis, columns = anatomy.parent.axis, grid(design, size).columns
    across = planes(axis)
    abscissa_mm = np.linspace(0.0, axis.length_mm, max(8, round(axis.length_mm / STEP_MM) + 1))
    radius_mm = np.interp(abscissa_mm, axis.abscissa_mm, axis.inscribed_radius_mm)
    dd_mm = design.wall_offset_um * MM_PER_UM
    inner = circles(np.minimum(radius_mm - dd_mm, 0.5 * widest_mm(design, size)), columns)
    centers_mm, frames = across.at(abscissa_mm)
    rays = circles(np.ones(len(abscissa_mm)), columns) @ frames[:, 1:]
    origins_mm = np.repeat(centers_mm, columns, axis=0)
    reach_mm = surface.first_hit(origins_mm, rays.reshape(-1, 3)).reshape(-1, columns)
    # Rays that leave through an end of the artery or run along a bend do not measure the wall.
    section_mm = np.interp(abscissa_mm, axis.abscissa_mm, anatomy.parent.section_radius_mm)[:, None]
    reach_mm = np.where(reach_mm < 1.6 * section_mm, reach_mm, section_mm)
    outer = np.maximum(reach_mm - dd_mm, 0.1)[..., None] * circles(np.ones(len(abscissa_mm)), columns)
    in_plane_mm = evenly_spaced(grown(inner, outer, np.full(len(inner), widest_mm(design, size)))[0])
    nodes_mm = across.place(abscissa_mm, in_plane_mm).reshape(-1, 3)
    gap_mm = np.maximum(surface.closest(nodes_mm)[1] - dd_mm, 0.0).reshape(-1, columns)
    band_mm = anatomy.vessel.threshold_band_mm or ASSUMED_BAND_MM
    is_opening = over_openings(anatomy, nodes_mm).reshape(gap_mm.shape)
    expected = expected_profile(design, size, anatomy)
    return MeasuredWall(design, size, across, abscissa_mm, in_plane_mm, gap_mm, is_opening, expected, band_mm)


def sketch(wall: MeasuredWall, landing: Landing) -> Sketch:
    """Preview the device on a wall that is measured for it; a LandingError says that it extends beyond the artery."""
    design, size = wall.design, wall.size
    check_landing(landing, float(wall.abscissa_mm[-1]))
    marched_mm = rows_mm = march(design, size, landing, wall.profile)
    check_inside(design, size, rows_mm, float(wall.abscissa_mm[-1]))
    flat = np.concatenate([wall.in_plane_mm, wall.gap_mm[..., None]], axis=2).reshape(len(wall.abscissa_mm), -1)
    laid = curves.interpolate(wall.abscissa_mm, flat, rows_mm).reshape(len(rows_mm), -1, 3)
    in_plane_mm, gap_mm = laid[..., :2], laid[..., 2]
    if size.free_profile_mm:  # rows shrink to their free diameters
        free_mm, middle_mm = free_diameters_mm(design, size), in_plane_mm.mean(axis=1, keepdims=True)
        share = np.minimum(np.pi * free_mm / perimeters(in_plane_mm), 1.0)[:, None, None]
        inward_mm = (share - 1) * (in_plane_mm - middle_mm)
        in_plane_mm, gap_mm = in_plane_mm + inward_mm, gap_mm + np.linalg.norm(inward_mm, axis=2)
    held = landed_row(design, size, landing)
    is_opening = wall.is_opening[np.abs(np.subtract.outer(rows_mm, wall.abscissa_mm)).argmin(axis=1)]
    nodes_mm = wall.across.place(rows_mm, in_plane_mm)
    slid = pieces.slide(design, size, nodes_mm, held, cells.as_drawn, is_opening)
    rows_mm = pieces.extrapolated(np.arange(len(rows_mm)), rows_mm, slid.row.mean(axis=1))
    near = pieces.nearest(slid.row, len(rows_mm))
    gap_mm = np.take_along_axis(gap_mm, near, axis=0) + np.linalg.norm(slid.lift_mm, axis=2)
    nodes_mm = slid.nodes_mm + slid.lift_mm
    wires = draw(design, size, nodes_mm, None, slid.crowns)  # the contour already keeps the wires inside the artery
    stent = Stent(design, size, nodes_mm, rows_mm, *wires, slid.crowns.shift_mm)
    ends_mm = []
    for wider_mm in (-wall.diameter_band_mm, wall.diameter_band_mm):
        diameter_mm = np.minimum(wall.profile.diameter_mm + wider_mm, widest_mm(design, size))
        other_mm = march(design, size, landing, replace(wall.profile, diameter_mm=diameter_mm))
        ends_mm.append((other_mm + (rows_mm - marched_mm))[[0, -1]].tolist())
    (first, last), (other_first, other_last) = ends_mm
    return Sketch(stent, gap_mm, (first, other_first), (last, other_last))
