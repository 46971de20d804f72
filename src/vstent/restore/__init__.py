"""Restore the parent artery: find the sac, and close its neck and the side branches' ostia.

The paper (Zhong et al. 2016) shrinks the sac by hand ("aneurysm scaling"). Here it is found: the wall that stands out
of the tubes around all centerlines is a sac where it stands out by more than the artery's own radius. The parent
artery is then a tube around its own axis (`axis`), its wall the patient's own except across necks and ostia, where it
is closed by the smoothest surface through the wall around them (`landing`). What of the lumen lies outside that tube
and holds the sac's dome is the sac (`sac`).
"""

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
        _notes(vessel, path, aneurysms, len(bulges)),
    )


def _sacs(vessel: Vessel, landing: Landing, side_lines: list[Centerline], bulges: list[Bulge]) -> list[Aneurysm]:
    """The sacs of those bulges that hang on the parent artery and are not flat."""
    cut = (cut_sac(vessel, landing, side_lines, bulge) for bulge in bulges)
    return [sac for sac in cut if sac is not None]


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
    """Tell whether the first of two centerlines is the wider over `REACH_MM` beyond their fork, off the sac."""
    return _width_beyond_fork(one, other, one_is_off) >= _width_beyond_fork(other, one, other_is_off)


def _width_beyond_fork(line: Centerline, other: Centerline, is_off: Bools) -> float:
    distance = curves.project(other.points_mm, line.points_mm)[1]
    apart = np.flatnonzero((distance > line.inscribed_radius_mm) & is_off)
    fork_mm = line.abscissa_mm[apart[0]] if len(apart) else line.length_mm
    beyond = (line.abscissa_mm >= fork_mm) & (line.abscissa_mm <= fork_mm + REACH_MM)
    return float(np.median(line.inscribed_radius_mm[beyond]))


def _notes(vessel: Vessel, path: int, aneurysms: tuple[Aneurysm, ...], n_bulges: int) -> tuple[str, ...]:
    outlet = vessel.outlets[path]
    notes = [f"The parent artery runs from the inlet to {outlet.role} (diameter {outlet.diameter_mm:.1f} mm)."]
    if not aneurysms:
        notes.append("No sac was found: the landing surface is the artery's own wall with its side branches closed.")
    if n_bulges > len(aneurysms) > 0:
        notes.append(f"{n_bulges - len(aneurysms)} more bulges are flat or hang on other branches: left in the lumen.")
    return tuple(notes)
