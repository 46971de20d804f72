"""Restore the parent artery: find the sac, and close its neck and the side branches' ostia.

The paper (Zhong et al. 2016) shrinks the sac by hand ("aneurysm scaling"). Here it is found: the wall that stands out
of the tubes around all centerlines is a sac where it stands out by more than the artery's own radius. The parent
artery is then a tube around its own axis (`axis`), its wall the patient's own except across necks and ostia, where it
is closed by the smoothest surface through the wall around them (`landing`). What of the lumen lies outside that tube
and holds the sac's dome is the sac (`sac`).
"""

from collections.abc import Sequence
from functools import reduce
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from vstent.errors import InputError, VesselError
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats
from vstent.restore.axis import Mouth, fit_axis
from vstent.restore.bulges import Bulge, find_bulges
from vstent.restore.drawn import cut_along
from vstent.restore.landing import Landing, close_landing
from vstent.restore.sac import cut_sac, drawn_sac
from vstent.restore.tubes import tubes_of
from vstent.trace import parent_radius_mm
from vstent.vessel import Anatomy, Aneurysm, Centerline, Vessel

REACH_MM: Final = 10.0
"""At a fork, the parent artery goes on where the vessel is wider over this length."""
ON_FOOT: Final = 1.5
"""A foot, which rises to half a radius above the nearest artery, is an artery's own up to this many of its radii."""
IN_SAC: Final = 1.2
"""A sphere reaches into a sac whose wall is within this many of its radii."""
PASSING: Final = 2.0
"""A centerline passes a bulge that begins within this many parent radii of it (a bulge's wall begins at 1.5)."""
ON_SAC_MM: Final = 0.05
"""What lies for the most part no further outside a sac than this is a part of it."""
FUSIFORM: Final = 1.5
"""An artery that is wider by this factor than at both its ends is told..."""
END_MM: Final = 2.0
"""... which are as wide as they are over this length."""
NEAR_SAC_MM: Final = 4.0
"""An opening so near to a sac's wall is told."""

__all__ = ["restore"]


def restore(
    vessel: Vessel, *, at_mm: Floats | None = None, outlet_mm: Floats | None = None, neck_mm: Floats | None = None
) -> Anatomy:
    """Return the anatomy of a traced vessel: parent artery, landing surface, sacs.

    Parameters
    ----------
    vessel : a vessel with centerlines.
    at_mm : (3,) a point near the sac wanted; all sacs otherwise.
    outlet_mm : (3,) a point near the outlet that the parent artery leads to; the widest way on otherwise.
    neck_mm : (k, 3) a neck drawn by hand, a closed curve near the wall: what it parts from the inlet is a sac, and
        the only one; necks are found otherwise.

    Raises
    ------
    InputError
        When nothing stands out of the artery near `at_mm`, or `neck_mm` does not part a sac from the artery.
    VesselError
        When the vessel has no centerlines.
    """
    if not vessel.centerlines:
        raise VesselError("the vessel has no centerlines: trace it before restoring its parent artery")
    drawn = None if neck_mm is None else cut_along(vessel, neck_mm)
    bulges = [drawn.bulge] if drawn else find_bulges(vessel.lumen, tubes_of(vessel.centerlines), at_mm)
    if at_mm is not None and not bulges:
        x, y, z = np.asarray(at_mm, dtype=float)
        raise InputError(f"no sac stands out of the artery near {x:.1f}, {y:.1f}, {z:.1f} mm: give a point in its dome")
    path = _parent_path(vessel, bulges, outlet_mm)
    mouths = [Mouth(_foot_on(vessel.centerlines[path], bulge), bulge.inward) for bulge in bulges]
    tube = fit_axis(vessel.lumen, vessel.centerlines[path], mouths)
    landing = close_landing(vessel.lumen, tube, drawn.artery if drawn else None)
    side_lines = [line for k, line in enumerate(vessel.centerlines) if k != path]
    sacs = [drawn_sac(vessel, landing, side_lines, drawn)] if drawn else _sacs(vessel, landing, side_lines, bulges)
    aneurysms = tuple(sorted(sacs, key=lambda sac: -sac.sac.volume_mm3))
    return Anatomy(
        vessel,
        landing.axis,
        landing.section_radius_mm,
        landing.surface,
        landing.is_restored.ravel(),
        aneurysms,
        (
            *_notes(vessel, path, aneurysms, len(bulges)),
            *_near_sacs(vessel, bulges),
            *_fusiform(vessel.centerlines[path], [bulge for bulge in bulges if _is_in_one(bulge.points_mm, aneurysms)]),
        ),
    )


def _sacs(vessel: Vessel, landing: Landing, side_lines: list[Centerline], bulges: list[Bulge]) -> list[Aneurysm]:
    """The sacs of those bulges that hang on the parent artery and are not flat."""
    found: list[Aneurysm] = []
    for bulge in bulges:
        sac = cut_sac(vessel, landing, side_lines, bulge)
        # Bulges apart above the tubes may be one sac above the landing surface, which lies lower.
        found += [] if sac is None or _is_in_one(sac.sac.vertices_mm, found) else [sac]
    return found


def _is_in_one(points_mm: Floats, aneurysms: Sequence[Aneurysm]) -> bool:
    """Tell whether most of the points (n, 3) of a sac or bulge lie in or on one of the sacs."""
    return any(np.median(one.sac.signed_distance(points_mm)) < ON_SAC_MM for one in aneurysms)


def _parent_path(vessel: Vessel, bulges: list[Bulge], outlet_mm: Floats | None) -> int:
    """Number of the centerline that the parent artery follows: past the sac, and at every fork the wider way."""
    lines = vessel.centerlines
    if outlet_mm is not None:
        ends = np.array([opening.center_mm for opening in vessel.outlets])
        return int(np.argmin(np.linalg.norm(ends - np.asarray(outlet_mm), axis=1)))
    reach = np.array([_reach(line, bulges[0]) if bulges else 0.0 for line in lines])
    passing = np.flatnonzero(reach <= max(PASSING, 1.25 * reach.min()))
    off = [_is_off_sac(line, bulges) for line in lines]
    return int(reduce(lambda i, k: i if _is_wider(lines[i], lines[k], off[i], off[k]) else k, passing))


def _is_off_sac(line: Centerline, bulges: list[Bulge]) -> Bools:
    """Tell the points (n,) of a centerline whose inscribed spheres do not reach into a sac: it makes them wide."""
    if not bulges:
        return np.ones(len(line.points_mm), dtype=bool)
    return np.asarray(bulges[0].distances_mm(line.points_mm) > IN_SAC * line.inscribed_radius_mm)


def _reach(line: Centerline, bulge: Bulge) -> float:
    """Least distance between a centerline and the foot of a bulge, in parent radii; the wall itself is at 1."""
    radius = parent_radius_mm(line.abscissa_mm, line.inscribed_radius_mm)
    return float((cKDTree(bulge.foot_mm).query(line.points_mm)[0] / radius).min())


def _foot_on(line: Centerline, bulge: Bulge) -> Floats:
    """Points (k, 3) of a bulge's foot that stand on the artery along a centerline; all where none does.

    Where a branch leaves from the sac beside its neck, the foot goes around the branch's mouth too.
    """
    tubes = tubes_of([line])
    height, sphere = tubes.height_mm(bulge.foot_mm)
    on_artery = bulge.foot_mm[height < ON_FOOT * tubes.radius_mm[sphere]]
    return on_artery if len(on_artery) else bulge.foot_mm


def _is_wider(one: Centerline, other: Centerline, one_is_off: Bools, other_is_off: Bools) -> bool:
    """Tell whether the first of two centerlines is the wider over `REACH_MM` beyond their fork."""
    return _width_beyond_fork(one, other, one_is_off) >= _width_beyond_fork(other, one, other_is_off)


def _width_beyond_fork(line: Centerline, other: Centerline, is_off: Bools) -> float:
    """Median radius of a centerline over `REACH_MM` beyond its fork from another; 0 where it parts in the sac alone."""
    distance = curves.project(other.points_mm, line.points_mm)[1]
    apart = np.flatnonzero((distance > line.inscribed_radius_mm) & is_off)
    if not len(apart):
        return 0.0
    fork_mm = line.abscissa_mm[apart[0]]
    beyond = (line.abscissa_mm >= fork_mm) & (line.abscissa_mm <= fork_mm + REACH_MM)
    # A way that is mostly in the sac is a branch of the sac: the sac's own width is none of its.
    own = beyond & is_off if (beyond & is_off).sum() < 0.5 * beyond.sum() else beyond
    return float(np.median(line.inscribed_radius_mm[own]))


def _notes(vessel: Vessel, path: int, aneurysms: tuple[Aneurysm, ...], n_bulges: int) -> tuple[str, ...]:
    outlet = vessel.outlets[path]
    notes = [f"The parent artery runs from the inlet to {outlet.role} (diameter {outlet.diameter_mm:.1f} mm)."]
    if not aneurysms:
        notes.append("No sac was found: the landing surface is the artery's own wall with its side branches closed.")
    if n_bulges > len(aneurysms) > 0:
        n_other = n_bulges - len(aneurysms)
        notes.append(f"{n_other} more bulges are flat, lobes of a sac, or on other branches: no sacs of their own.")
    return tuple(notes)


def _fusiform(line: Centerline, bulges: list[Bulge]) -> tuple[str, ...]:
    """A sentence where the artery along a centerline widens all round, off its sacs."""
    radius = np.where(np.all([_is_off_sac(line, [bulge]) for bulge in bulges], axis=0), line.inscribed_radius_mm, 0.0)
    at_end = np.minimum(line.abscissa_mm, line.length_mm - line.abscissa_mm) < END_MM
    is_first = line.abscissa_mm < 0.5 * line.length_mm
    ends_mm = max(float(np.median(line.inscribed_radius_mm[at_end & side])) for side in (is_first, ~is_first))
    widest = int(np.argmax(radius))
    if radius[widest] < FUSIFORM * ends_mm:
        return ()
    x, y, z = line.points_mm[widest]
    return (
        f"The artery is {2 * radius[widest]:.1f} mm wide at {x:.1f}, {y:.1f}, {z:.1f} mm and {2 * ends_mm:.1f} mm at "
        "its wider end: a fusiform aneurysm is no sac here, has no neck, and stays part of the landing surface.",
    )


def _near_sacs(vessel: Vessel, bulges: list[Bulge]) -> tuple[str, ...]:
    """Sentences on the outlets that lie on a sac or beside one: holes in it, or branches cut off at their mouth."""
    notes = []
    for opening in vessel.outlets:
        gap_mm = min((float(bulge.distances_mm(opening.center_mm[None])[0]) for bulge in bulges), default=np.inf)
        if gap_mm < NEAR_SAC_MM:
            x, y, z = opening.center_mm
            notes.append(
                f"{opening.role}, {opening.diameter_mm:.1f} mm wide at {x:.1f}, {y:.1f}, {z:.1f} mm, lies "
                f"{gap_mm:.1f} mm from a sac's wall: close it where it is a hole; give --outlet where the parent "
                "artery leads elsewhere."
            )
    return tuple(notes)
