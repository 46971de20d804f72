"""Restore the parent artery: find the sac, and close its neck and the ostia of the side branches.

Zhong et al. 2016 shrink the sac by hand ("aneurysm scaling"). Here it is found automatically: a sac is wall that rises
above the tubes around all centerlines by more than the artery's own radius. The parent artery is a tube around its own
axis (`axis`). Its wall is the patient's own, except across necks and ostia, where the smoothest surface through the
surrounding wall closes it (`landing`). The sac is the lumen outside that tube that contains the dome (`sac`).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from vstent.anatomy.continuation import continued
from vstent.anatomy.restore.axis import Mouth, fit_axis
from vstent.anatomy.restore.bulges import Bulge, find_bulges, flat_bulges
from vstent.anatomy.restore.candidates import classified
from vstent.anatomy.restore.drawn import Drawn, cut_along
from vstent.anatomy.restore.landing import Landing, close_landing
from vstent.anatomy.restore.notes import told
from vstent.anatomy.restore.path import PASSING, parent_path, reach_of
from vstent.anatomy.restore.plane import plane_sac
from vstent.anatomy.restore.sac import cut_sac, drawn_sac, is_beside_branch, is_in_one, is_sac
from vstent.anatomy.restore.tubes import Tubes, tubes_of
from vstent.errors import InputError, VesselError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import PARENT, Anatomy, Aneurysm, Candidate, Centerline, Path, Vessel
from vstent.kernels import triangles
from vstent.kernels.arrays import Floats
from vstent.units import place

ON_FOOT: Final = 1.5
"""Points of a bulge's foot up to this many artery radii above the artery are on that artery. A foot rises to half a
radius above the nearest artery."""
OFF_PLANE: Final = 1 / 3
"""A neck beside a branch follows the arteries' wall if it is within this many neck diameters of the neck plane."""
NECK_SEEN: Final = 0.4
"""A neck beside a branch follows the arteries' wall if its projection has at least this fraction of the area of the
section by the neck plane. Necks of phantoms on one artery have 0.49 to 0.66, curves that enclose part of a neck at a
fork 0.15 to 0.32."""
LEAST_MM2: Final = 0.1
"""Area of the smallest neck, in mm2: that of a circle of 0.36 mm, the size of a voxel."""
MOST_FLAT: Final = 3
"""Number of flat bulges that are examined at most: one on a branch takes as long as restoring the artery."""


def restore(
    vessel: Vessel, *, at_mm: Floats | None = None, outlet_mm: Floats | None = None, neck_mm: Floats | None = None
) -> Anatomy:
    """Restore the parent artery of a traced vessel and cut off its sacs.

    Parameters
    ----------
    vessel : vessel with centerlines.
    at_mm : (3,) point near the requested sac in mm; all sacs where not given.
    outlet_mm : (3,) point in mm near the opening at the end of the parent artery; the widest path to an outlet where
        not given.
    neck_mm : (k, 3) closed curve near the wall in mm: a neck drawn by hand. The part that it separates from the inlet
        is the only sac. Necks are found automatically where not given.

    Returns
    -------
    anatomy : parent artery, landing surface, sacs and candidates.

    Raises
    ------
    InputError
        When there is no bulge near `at_mm`, or `neck_mm` does not separate a sac from the artery.
    VesselError
        When the vessel has no centerlines, or no tube fits the wall along them.
    """
    if not vessel.centerlines:
        raise VesselError("the vessel has no centerlines: trace it before restoring its parent artery")
    drawn = None if neck_mm is None else cut_along(vessel, neck_mm)
    bulges = [drawn.bulge] if drawn else find_bulges(vessel.lumen, tubes_of(vessel.centerlines), at_mm)
    if at_mm is not None and not bulges:
        raise InputError(
            f"nothing bulges out of the artery near {place(at_mm)}: give a point in the dome of the sac, in LPS mm"
        )
    found = bulges
    path, landing, sacs = _closed(vessel, bulges, outlet_mm, drawn)
    candidates = [_classified(vessel, landing, sac) for sac in sacs]
    if drawn is None and at_mm is None:
        others: list[Candidate] = []
        while bulges and not any(one.is_aneurysm for one in candidates):
            others += candidates
            left = [bulge for bulge in bulges if not is_in_one(bulge.points_mm, sacs)]
            bulges = left if len(left) < len(bulges) else bulges[1:]
            path, landing, sacs = _closed(vessel, bulges, outlet_mm)
            candidates = [_classified(vessel, landing, sac) for sac in sacs]
        sacs = [sac for sac, one in zip(sacs, candidates, strict=True) if one.is_aneurysm]
        candidates += others
    aneurysms = tuple(sorted(sacs, key=lambda sac: -sac.sac.volume_mm3))
    if at_mm is not None and not aneurysms:
        off_way = (
            f"the artery to {vessel.far_ends[path].role} does not pass the bulge near {place(at_mm)}: leave out the "
            "outlet (--outlet), or give another one"
        )
        flat_bulge = (
            f"the bulge near {place(at_mm)} is too flat: no sac is left beyond its neck. Give a point in the dome of "
            "another one, in LPS mm, or draw its neck (--neck)."
        )
        raise InputError(flat_bulge if outlet_mm is None else off_way)
    flat = None if aneurysms or at_mm is not None else _flat_sac(vessel, outlet_mm, path, landing)
    parent = Path(PARENT, landing.axis, landing.section_radius_mm, landing.surface, landing.is_restored.ravel())
    notes = told(vessel, path, bulges or found, aneurysms, candidates, flat, is_drawn=drawn is not None)
    return continued(Anatomy(vessel, (parent,), aneurysms, notes, tuple(candidates)))


def _closed(
    vessel: Vessel, bulges: Sequence[Bulge], outlet_mm: Floats | None, drawn: Drawn | None = None
) -> tuple[int, Landing, list[Aneurysm]]:
    """Return the index of the parent artery's centerline, its landing surface, and the sacs cut off from it."""
    path = parent_path(vessel, list(bulges), outlet_mm)
    landing = _landing(vessel, path, bulges, drawn.artery if drawn else None)
    if drawn:
        return path, landing, [drawn_sac(vessel, landing, _all_but(path, vessel.centerlines), drawn)]
    tubes, sacs = tubes_of(vessel.centerlines), list[Aneurysm]()
    for bulge in bulges:
        sac = _sac(vessel, path, landing, tubes, bulge)
        # Bulges that are separate above the tubes may be one sac above the landing surface, which is lower.
        if sac is not None and sac.neck.area_mm2 > LEAST_MM2 and not is_in_one(sac.sac.vertices_mm, sacs):
            sacs.append(sac)
    return path, landing, sacs


def _classified(vessel: Vessel, landing: Landing, sac: Aneurysm) -> Candidate:
    """Return the class of a sac, from its shape and the parent artery's diameter at its neck."""
    abscissa_mm = landing.axis.nearest_abscissa_mm(sac.neck_mm)
    middle_mm = 0.5 * float(abscissa_mm.min() + abscissa_mm.max())
    return classified(vessel, sac, 2 * float(np.interp(middle_mm, landing.axis.abscissa_mm, landing.section_radius_mm)))


def _landing(vessel: Vessel, path: int, bulges: Sequence[Bulge], own: Surface | None = None) -> Landing:
    """Return the landing surface along a centerline, with the necks of bulges closed; `own`: see `close_landing`."""
    line, mouths = vessel.centerlines[path], []
    for bulge in bulges:
        # Where a branch arises from the sac beside its neck, the foot runs around the mouth of the branch too.
        tubes = tubes_of([line])
        height, sphere = tubes.height_mm(bulge.foot_mm)
        on_artery = bulge.foot_mm[height < ON_FOOT * tubes.radius_mm[sphere]]
        mouths.append(Mouth(on_artery if len(on_artery) else bulge.foot_mm, bulge.inward))
    return close_landing(vessel.lumen, fit_axis(vessel.lumen, line, mouths), own)


def _flat_sac(vessel: Vessel, outlet_mm: Floats | None, path: int, landing: Landing) -> Bulge | None:
    """Return the first flat bulge (a blister) that can be cut off as a sac on request; None without one."""
    # Flat bulges hardly affect the fit of the artery, so one landing surface serves all bulges on a path.
    flat = flat_bulges(vessel.lumen, tubes_of(vessel.centerlines))[:MOST_FLAT]
    landings = {path: landing}
    # Forks and bends bulge as much as a blister. After restoring the artery they are part of it.
    for bulge in flat:
        way = parent_path(vessel, [bulge], outlet_mm)
        if way not in landings:
            landings[way] = _landing(vessel, way, ())
        if cut_sac(vessel, landings[way], _all_but(way, vessel.centerlines), bulge):
            return bulge
    return None


def _all_but(path: int, lines: Sequence[Centerline]) -> list[Centerline]:
    """Return the centerlines without the one at index `path`."""
    return [line for k, line in enumerate(lines) if k != path]


def _sac(vessel: Vessel, path: int, landing: Landing, tubes: Tubes, bulge: Bulge) -> Aneurysm | None:
    """Return the sac of a bulge, closed by the wall of its arteries or by its neck plane; None where it is no sac."""
    side_lines = _all_but(path, vessel.centerlines)
    curved, flat = cut_sac(vessel, landing, side_lines, bulge), plane_sac(vessel.lumen, tubes, bulge)
    if flat is None:
        return curved
    if curved is None:
        is_on_artery = reach_of(vessel.centerlines[path], bulge) <= PASSING
        return flat if is_on_artery and is_sac(flat) else None
    # Where branches leave under a sac, no single wall passes below it, and the curve may follow one of them.
    plane = flat.plane
    assert plane is not None
    if is_beside_branch(landing, side_lines, bulge):
        off_mm = np.abs((curved.neck_mm - plane.center_mm) @ plane.normal).max()
        seen_mm2 = abs(triangles.polygon_area_vector(curved.neck_mm) @ plane.normal)
        if off_mm >= OFF_PLANE * np.sqrt(4 * plane.area_mm2 / np.pi) or seen_mm2 <= NECK_SEEN * plane.area_mm2:
            return flat
    return replace(curved, plane=plane)
