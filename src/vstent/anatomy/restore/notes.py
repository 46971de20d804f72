"""Notes on an anatomy: one sentence for each finding, each assumption and each possible error."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from vstent.anatomy.restore.bulges import Bulge
from vstent.anatomy.restore.path import PASSING, is_off_sacs, reach_of
from vstent.anatomy.restore.sac import is_in_one
from vstent.anatomy.trace import parent_radius_mm
from vstent.geometry.vessel import Aneurysm, Candidate, Centerline, Opening, Vessel
from vstent.kernels import curves
from vstent.units import counted, place

FUSIFORM: Final = 1.5
"""An artery wider than both its ends by this factor is reported as fusiform."""
END_MM: Final = 2.0
"""Length in mm over which the width of an end is measured."""
NEAR_SAC_MM: Final = 4.0
"""An opening closer than this to the wall of a sac, in mm, is reported."""
UNCERTAIN: Final = 1.25
"""A neck is reported as uncertain where the largest area of nearly as good planes exceeds the smallest by this
factor."""
STENOSED: Final = 0.7
"""A stenosis is reported where the width beside a neck is below this fraction of the widths on both sides of it."""
STENOSED_REACH: Final = 2.0
"""Largest distance of a reported stenosis from the neck, in diameters."""


def told(vessel: Vessel, path: int, bulges: list[Bulge], aneurysms: tuple[Aneurysm, ...]) -> tuple[str, ...]:
    """Return notes on the parent artery and its sacs.

    Parameters
    ----------
    vessel : vessel with centerlines.
    path : index of the parent artery's centerline.
    bulges : bulges that were found.
    aneurysms : sacs that were cut off.
    """
    line, sacs = vessel.centerlines[path], [bulge for bulge in bulges if is_in_one(bulge.points_mm, aneurysms)]
    return (
        *_found(vessel, path, aneurysms, len(bulges)),
        *_before_another(vessel, path, bulges),
        *_near_sacs(vessel, bulges),
        *_from_sacs(vessel, path, aneurysms),
        *_fusiform(line, sacs),
        *(note for sac in aneurysms for note in _stenosed(line, sac)),
    )


def necks_told(aneurysms: Sequence[Aneurysm]) -> tuple[str, ...]:
    """Return notes on sacs whose neck is cut by an uncertain plane, or that have no plane."""
    notes = []
    for aneurysm in aneurysms:
        if aneurysm.plane is None:
            notes.append(
                f"No plane separates the sac at {place(aneurysm.neck_mm.mean(axis=0))} from all arteries. Its heights, "
                "widths and volume by plane refer to the mean plane of its neck curve."
            )
            continue
        low_mm2, high_mm2 = aneurysm.plane.area_band_mm2
        is_cut = np.array_equal(aneurysm.neck_mm, aneurysm.plane.rim_mm)
        if is_cut and high_mm2 > UNCERTAIN * low_mm2:
            notes.append(
                f"The neck is uncertain: its area is {aneurysm.plane.area_mm2:.1f} mm2, and {low_mm2:.1f} to "
                f"{high_mm2:.1f} mm2 for planes that separate the sac nearly as well."
            )
    return tuple(notes)


def candidates_told(aneurysms: Sequence[Aneurysm], candidates: Sequence[Candidate]) -> tuple[str, ...]:
    """Return a note on bulges that are not used as aneurysms, with how to choose one."""
    others = [one.described for one in candidates if not one.is_aneurysm]
    if not others:
        return ()
    begins = "Not taken for aneurysms" if aneurysms else "No convincing aneurysm was found; candidates"
    return (f"{begins}: {'; '.join(others)}. Choose one by a point in it (--at).",)


def flat_told(bulge: Bulge | None) -> tuple[str, ...]:
    """Return a note on a bulge that is used as a sac only on request."""
    if bulge is None:
        return ()
    return (
        f"A bulge {bulge.height_mm:.1f} mm high at {place(bulge.dome_mm)} is too flat to be used as a sac "
        "unless it is chosen by that point (--at).",
    )


def _found(vessel: Vessel, path: int, aneurysms: tuple[Aneurysm, ...], n_bulges: int) -> tuple[str, ...]:
    """Return notes on the course of the parent artery and the number of sacs."""
    end = vessel.far_ends[path]
    notes = [f"The parent artery runs from the inlet to {end.role} (diameter {end.diameter_mm:.1f} mm)."]
    if not aneurysms:
        notes.append("No sac was found: the landing surface is the artery's own wall with its side branches closed.")
    if n_bulges > len(aneurysms) > 0:
        more = counted(n_bulges - len(aneurysms), "more bulge")
        notes.append(f"{more} not used: flat, a lobe of a sac, or on another branch.")
    return tuple(notes)


def _before_another(vessel: Vessel, path: int, bulges: list[Bulge]) -> tuple[str, ...]:
    """Return a note where the highest bulge is on the artery from another inlet, upstream of the parent artery."""
    if not bulges or reach_of(vessel.centerlines[path], bulges[0]) <= PASSING:
        return ()
    return tuple(
        f"The bulge {bulges[0].height_mm:.1f} mm high at {place(bulges[0].dome_mm)} is on the artery from "
        f"{end.role}, {end.described}: give that opening as the first inlet (--inlet)."
        for end, line in zip(vessel.far_ends, vessel.centerlines, strict=True)
        if end.is_inlet and reach_of(line, bulges[0]) <= PASSING
    )


def _fusiform(line: Centerline, bulges: list[Bulge]) -> tuple[str, ...]:
    """Return a note where the artery along a centerline is wider on all sides, away from its sacs."""
    radius = np.where(is_off_sacs(line, bulges), line.inscribed_radius_mm, 0.0)
    at_end = np.minimum(line.abscissa_mm, line.length_mm - line.abscissa_mm) < END_MM
    is_first = line.abscissa_mm < 0.5 * line.length_mm
    ends_mm = max(float(np.median(line.inscribed_radius_mm[at_end & side])) for side in (is_first, ~is_first))
    widest = int(np.argmax(radius))
    if radius[widest] < FUSIFORM * ends_mm:
        return ()
    return (
        f"The artery is {2 * radius[widest]:.1f} mm wide at {place(line.points_mm[widest])} and "
        f"{2 * ends_mm:.1f} mm at its wider end. A fusiform aneurysm has no neck; it remains part of the "
        "landing surface.",
    )


def _stenosed(line: Centerline, aneurysm: Aneurysm) -> tuple[str, ...]:
    """Return notes where the artery narrows beside a neck and is wide again on both sides of the stenosis."""
    # The width of the artery under a neck is estimated from the width beside it. A stenosis makes that estimate too
    # small.
    # The width of the artery under a neck is estimated from the width beside it. A stenosis makes that estimate too
    # small.
    abscissa, radius = line.abscissa_mm, line.inscribed_radius_mm
    at_neck = curves.project(line.points_mm, aneurysm.neck_mm)[0]
    gap_mm = np.maximum(at_neck.min() - abscissa, abscissa - at_neck.max())
    reach_mm = STENOSED_REACH * 2.0 * parent_radius_mm(abscissa, radius)[np.argmin(gap_mm)]
    upstream, downstream = (
        side & (gap_mm > 0) & (gap_mm < reach_mm) for side in (abscissa < at_neck.min(), abscissa > at_neck.max())
    )
    if not (upstream.any() and downstream.any()):
        return ()
    notes = []
    for side, other in ((upstream, downstream), (downstream, upstream)):
        throat = int(np.argmin(np.where(side, radius, np.inf)))
        beyond_mm = float(radius[side & (gap_mm > gap_mm[throat])].max(initial=0.0))
        around_mm = min(beyond_mm, float(radius[other].max()))
        if radius[throat] < STENOSED * around_mm:
            notes.append(
                f"The artery is {2 * radius[throat]:.1f} mm wide at {place(line.points_mm[throat])}, "
                f"{gap_mm[throat]:.1f} mm from a neck, and {2 * around_mm:.1f} mm on both sides of it: a "
                "stenosis. The landing surface may lie inside the wall between there and the neck. Look at "
                "it, and draw the neck by hand if it is too large (--neck)."
            )
    return tuple(notes)


def _near_sacs(vessel: Vessel, bulges: list[Bulge]) -> tuple[str, ...]:
    """Return notes on openings on a sac or near one: holes in it, or branches cut off at their mouth."""
    notes = []
    for opening in vessel.far_ends:
        gap_mm = min((float(bulge.distances_mm(opening.center_mm[None])[0]) for bulge in bulges), default=np.inf)
        if gap_mm < NEAR_SAC_MM:
            notes.append(
                f"{opening.role}, {opening.described}, is {gap_mm:.1f} mm from the wall of a sac. Close it in "
                "the surface if it is a hole, or choose another outlet if the parent artery leads elsewhere "
                "(--outlet)."
            )
    return tuple(notes)


def _from_sacs(vessel: Vessel, path: int, aneurysms: tuple[Aneurysm, ...]) -> tuple[str, ...]:
    """Return notes on branches that arise from a sac: their blood flows through it with any device."""
    branches = [one for k, one in enumerate(zip(vessel.far_ends, vessel.centerlines, strict=True)) if k != path]
    return tuple(_through_sac(opening) for opening, line in branches if any(_leaves(line, one) for one in aneurysms))


def _through_sac(opening: Opening) -> str:
    """Return a note on an opening whose blood flows through a sac."""
    way, beside = ("opens into", ", and is not part of the neck inflow") if opening.is_inlet else ("leaves from", "")
    return f"{opening.role}, {opening.described}, {way} a sac: its blood flows through the sac with any device{beside}."


def _leaves(line: Centerline, aneurysm: Aneurysm) -> bool:
    """Return whether a centerline leaves a sac other than through its neck."""
    inside = np.flatnonzero(aneurysm.sac.signed_distance(line.points_mm) < 0)
    last = inside[-1:]
    return bool((aneurysm.neck.closest(line.points_mm[last])[1] > line.inscribed_radius_mm[last]).any())
