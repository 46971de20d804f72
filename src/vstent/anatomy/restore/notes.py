"""Notes on an anatomy: one sentence for each finding, each assumption and each possible error."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from vstent.anatomy.morphology import beyond_plane
from vstent.anatomy.restore.bulges import Bulge
from vstent.anatomy.restore.path import PASSING, is_off_sacs, reach_of
from vstent.anatomy.restore.sac import is_in_one
from vstent.anatomy.trace import parent_radius_mm
from vstent.geometry.vessel import Aneurysm, Candidate, Centerline, Vessel
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
LARGER: Final = 1.3
"""A neck is reported as uncertain where the sac is larger than its part beyond the neck plane by this factor."""
WHOLE: Final = 0.7
"""A neck is reported as uncertain where less than this fraction of the bulge's wall is in the sac."""
STENOSED: Final = 0.7
"""A stenosis is reported where the width beside a neck is below this fraction of the widths on both sides of it."""
STENOSED_REACH: Final = 2.0
"""Largest distance of a reported stenosis from the neck, in diameters."""


def told(
    vessel: Vessel,
    path: int,
    bulges: list[Bulge],
    aneurysms: Sequence[Aneurysm],
    candidates: Sequence[Candidate],
    flat: Bulge | None,
    *,
    is_drawn: bool,
) -> tuple[str, ...]:
    """Return notes on the parent artery along centerline `path`, its sacs, and bulges that are not taken for sacs."""
    line, end = vessel.centerlines[path], vessel.far_ends[path]
    sacs = [bulge for bulge in bulges if is_in_one(bulge.points_mm, aneurysms)]
    notes = [f"The parent artery runs from the inlet to {end.role} (diameter {end.diameter_mm:.1f} mm)."]
    if not aneurysms:
        notes.append("No sac was found: the landing surface is the artery's own wall with its side branches closed.")
    elif len(bulges) > len(aneurysms):
        more = counted(len(bulges) - len(aneurysms), "more bulge")
        notes.append(f"{more} not used: flat, a lobe of a sac, or on another branch.")
    if len(aneurysms) > 1:
        places = [(one.sac.volume_mm3, place(one.sac.vertices_mm.mean(axis=0))) for one in aneurysms]
        listed = "; ".join(f"{volume_mm3:.0f} mm3 at {where}" for volume_mm3, where in places)
        notes.append(
            f"{len(aneurysms)} sacs, the largest first: {listed}. Devices and flow refer to the first; choose another "
            "one by a point in it (--at)."
        )
    notes += _on_another(vessel, path, bulges, has_sac=bool(aneurysms))
    notes += _near_sacs(vessel, bulges)
    notes += _from_sacs(vessel, path, aneurysms)
    notes += _fusiform(line, sacs)
    notes += [note for sac in aneurysms for note in _stenosed(line, sac)]
    notes += [] if is_drawn else [note for sac in aneurysms for note in _neck(sac)]
    others = [one.described for one in candidates if not one.is_aneurysm]
    if others:
        begins = "Not taken for aneurysms" if aneurysms else "No convincing aneurysm was found; candidates"
        notes.append(f"{begins}: {'; '.join(others)}. Choose one by a point in it (--at).")
    if flat is not None:
        notes.append(
            f"A bulge {flat.height_mm:.1f} mm high at {place(flat.dome_mm)} is too flat to be used as a sac "
            "unless it is chosen by that point (--at)."
        )
    return tuple(notes)


def _neck(aneurysm: Aneurysm) -> list[str]:
    """Return notes on a sac whose neck is cut by an uncertain plane, or that has no plane."""
    if aneurysm.plane is None:
        return [
            f"No plane separates the sac at {place(aneurysm.neck_mm.mean(axis=0))} from all arteries. Its heights, "
            "widths and volume by plane refer to the mean plane of its neck curve."
        ]
    low_mm2, high_mm2 = aneurysm.plane.area_band_mm2
    if not np.array_equal(aneurysm.neck_mm, aneurysm.plane.rim_mm):
        volume_mm3 = aneurysm.sac.volume_mm3
        beyond_mm3 = beyond_plane(aneurysm, aneurysm.plane.center_mm, aneurysm.plane.normal).volume_mm3
        if volume_mm3 < LARGER * beyond_mm3:
            return []
        return [
            f"The neck is uncertain: the sac has {volume_mm3:.0f} mm3 down to the wall of the artery, and "
            f"{beyond_mm3:.0f} mm3 beyond its neck plane, because its flank has no waist. Look at the neck, and draw "
            "it by hand if it is wrong (--neck)."
        ]
    notes = []
    if high_mm2 > UNCERTAIN * low_mm2:
        notes.append(
            f"The neck is uncertain: its area is {aneurysm.plane.area_mm2:.1f} mm2, and {low_mm2:.1f} to "
            f"{high_mm2:.1f} mm2 for planes that separate the sac nearly as well."
        )
    if aneurysm.plane.bulge_fraction < WHOLE:
        notes.append(
            f"The neck is uncertain: {1 - aneurysm.plane.bulge_fraction:.0%} of the wall that bulges at "
            f"{place(aneurysm.neck_mm.mean(axis=0))} is outside the sac: a lobe of it, or the stump of a branch. Look "
            "at the neck, and draw it by hand if a lobe is cut off (--neck)."
        )
    return notes


def _on_another(vessel: Vessel, path: int, bulges: list[Bulge], *, has_sac: bool) -> list[str]:
    """Return a note where the highest bulge is on the artery from another inlet, or without a sac to another outlet."""
    if not bulges or reach_of(vessel.centerlines[path], bulges[0]) <= PASSING:
        return []
    lies = f"The bulge {bulges[0].height_mm:.1f} mm high at {place(bulges[0].dome_mm)} is on the artery"
    passing = [
        end
        for end, line in zip(vessel.far_ends, vessel.centerlines, strict=True)
        if reach_of(line, bulges[0]) <= PASSING
    ]
    notes = [
        f"{lies} from {end.role}, {end.described}: give that opening as the first inlet (--inlet)."
        for end in passing
        if end.is_inlet
    ]
    outlets = [end.role for end in passing if not end.is_inlet]
    if outlets and not notes and not has_sac:
        notes.append(f"{lies} to {outlets[0]}: choose that outlet (--outlet), or none.")
    return notes


def _fusiform(line: Centerline, bulges: list[Bulge]) -> list[str]:
    """Return a note where the artery along a centerline is wider on all sides, away from its sacs."""
    radius = np.where(is_off_sacs(line, bulges), line.inscribed_radius_mm, 0.0)
    at_end = np.minimum(line.abscissa_mm, line.length_mm - line.abscissa_mm) < END_MM
    is_first = line.abscissa_mm < 0.5 * line.length_mm
    ends_mm = max(float(np.median(line.inscribed_radius_mm[at_end & side])) for side in (is_first, ~is_first))
    widest = int(np.argmax(radius))
    if radius[widest] < FUSIFORM * ends_mm:
        return []
    return [
        f"The artery is {2 * radius[widest]:.1f} mm wide at {place(line.points_mm[widest])} and "
        f"{2 * ends_mm:.1f} mm at its wider end. A fusiform aneurysm has no neck; it remains part of the "
        "landing surface."
    ]


def _stenosed(line: Centerline, aneurysm: Aneurysm) -> list[str]:
    """Return notes where the artery narrows beside a neck and is wide again on both sides of the stenosis."""
    # The width of the artery under a neck is estimated from the width beside it: too small beside a stenosis.
    abscissa, radius = line.abscissa_mm, line.inscribed_radius_mm
    at_neck = curves.project(line.points_mm, aneurysm.neck_mm)[0]
    gap_mm = np.maximum(at_neck.min() - abscissa, abscissa - at_neck.max())
    reach_mm = STENOSED_REACH * 2.0 * parent_radius_mm(abscissa, radius)[np.argmin(gap_mm)]
    upstream, downstream = (
        side & (gap_mm > 0) & (gap_mm < reach_mm) for side in (abscissa < at_neck.min(), abscissa > at_neck.max())
    )
    if not (upstream.any() and downstream.any()):
        return []
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
    return notes


def _near_sacs(vessel: Vessel, bulges: list[Bulge]) -> list[str]:
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
    return notes


def _from_sacs(vessel: Vessel, path: int, aneurysms: Sequence[Aneurysm]) -> list[str]:
    """Return notes on branches that leave a sac other than through its neck: their blood flows through it."""
    notes = []
    for k, (opening, line) in enumerate(zip(vessel.far_ends, vessel.centerlines, strict=True)):
        for aneurysm in aneurysms if k != path else ():
            last = np.flatnonzero(aneurysm.sac.signed_distance(line.points_mm) < 0)[-1:]
            if (aneurysm.neck.closest(line.points_mm[last])[1] > line.inscribed_radius_mm[last]).any():
                way = "opens into" if opening.is_inlet else "leaves from"
                beside = ", and is not part of the neck inflow" if opening.is_inlet else ""
                notes.append(
                    f"{opening.role}, {opening.described}, {way} a sac: its blood flows through the sac with any "
                    f"device{beside}."
                )
                break
    return notes
