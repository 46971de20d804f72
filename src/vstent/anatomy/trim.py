"""Trim the vessel to a given length of artery on both sides of the sac.

A scan shows the whole tree, but flow far from the sac adds run time and no information. Every artery that leads away
from the sac, branches included, is cut perpendicular to its centerline at the given length. A cut carries the flow of
the openings beyond it. It is an inlet where, by Murray's law, more blood enters through these openings than leaves.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from vstent.anatomy.openings import STILL, cut_square
from vstent.anatomy.restore.bulges import Bulge, find_bulges
from vstent.anatomy.restore.tubes import tubes_of
from vstent.anatomy.trace import parent_radius_mm, trace
from vstent.errors import InputError
from vstent.geometry.murray import murray_shares
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline, Vessel
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats
from vstent.units import place

UPSTREAM_MM: Final = 35.0
"""Default length of artery upstream of the sac's middle, in mm: half of the longest device, and five diameters for the
flow to develop."""
DOWNSTREAM_MM: Final = 25.0
"""Default length in mm of every other artery, downstream of the sac's middle or to another inlet."""
SPARE_MM: Final = 5.0
"""By default, an artery is cut only if more than this length is removed, in mm."""
SAME_MM: Final = 1e-6
"""Vertices closer than this are the same, in mm."""
STRIDE_MM: Final = 1.0
"""Length in mm of the centerline that defines the direction of a cut."""


class _Way(NamedTuple):
    """The artery on one side of the sac's middle."""

    side: str
    """Name of the side: before or beyond the sac."""
    option: str
    """Option that sets the length to keep."""
    usual_mm: float
    """Default length to keep."""
    given_mm: float | None
    """Length given by the user; None for the default."""
    neck_mm: float
    """Distance from the sac's middle to the edge of the neck."""
    clear_mm: float
    """Smallest distance between a cut and the neck."""
    whole_mm: float
    """Length of the artery."""

    @property
    def asked_mm(self) -> float:
        """The given length, or the default."""
        return self.usual_mm if self.given_mm is None else self.given_mm

    @property
    def is_short(self) -> bool:
        """Whether a cut at that length would be in the sac or too close to it."""
        return self.asked_mm < min(self.neck_mm + self.clear_mm, self.whole_mm)

    @property
    def has_grown(self) -> bool:
        """Whether the default length is too short and the least length is used instead."""
        return self.given_mm is None and self.is_short

    @property
    def least_mm(self) -> float:
        """Least length that clears the neck, rounded up to 0.1 mm."""
        return float(np.ceil(10 * (self.neck_mm + self.clear_mm)) / 10)

    @property
    def kept_mm(self) -> float:
        """Length to keep."""
        return self.least_mm if self.has_grown else self.asked_mm

    @property
    def spare_mm(self) -> float:
        """The artery is cut only if more than this length is removed."""
        return SPARE_MM if self.given_mm is None else 0.0


class _Cut(NamedTuple):
    """A cut through the artery."""

    center_mm: Floats
    """(3,) point on a centerline."""
    radius_mm: float
    """Radius of the artery at the cut."""
    sense: int
    """Side that is removed: behind (-1) or ahead (1) along the centerline."""


class _Site(NamedTuple):
    """Position of the sac on its artery."""

    parent: Centerline
    """Centerline of the artery."""
    sac_mm: float
    """Abscissa of the sac's middle on it."""
    before: _Way
    """Artery upstream of the sac's middle."""
    beyond: _Way
    """Artery downstream of the sac's middle."""


def trim(
    vessel: Vessel,
    *,
    at_mm: Floats | None = None,
    upstream_mm: float | None = None,
    downstream_mm: float | None = None,
) -> Vessel:
    """Trim a traced vessel around its largest sac, and trace it again.

    A vessel without a sac, or one that is already short enough, is returned unchanged.

    Parameters
    ----------
    vessel : vessel with centerlines.
    at_mm : (3,) point in mm near the sac to keep; the largest sac where not given.
    upstream_mm : length of artery to keep upstream of the sac's middle, in mm, above zero. Where not given, 35 mm are
        kept and an excess of up to 5 mm is not cut.
    downstream_mm : length to keep of every artery downstream of the sac's middle, in mm, above zero. Where not given,
        25 mm are kept and an excess of up to 5 mm is not cut.

    Returns
    -------
    vessel : trimmed vessel. Default lengths that are too short for the neck are extended, with a note.

    Raises
    ------
    InputError
        When a given length is not above zero, or so short that the cut would be within one artery radius of the neck.
    """
    _refuse_none(upstream_mm, downstream_mm)
    bulges = find_bulges(vessel.lumen, tubes_of(vessel.centerlines), at_mm)
    if not bulges:
        return vessel
    site = _site(vessel, bulges[0], upstream_mm, downstream_mm)
    lumen = vessel.lumen
    cuts: list[_Cut] = []
    for line, abscissa_mm, sense in _cuts(vessel, site):
        center, ahead = line.at(np.array([abscissa_mm, abscissa_mm + sense * STRIDE_MM]))
        direction = (ahead - center) / np.linalg.norm(ahead - center)
        radius = float(np.interp(abscissa_mm, line.abscissa_mm, line.inscribed_radius_mm))
        cut = cut_square(lumen, center, direction, radius)
        part = None if cut is None else Surface(*triangles.part_at(cut.vertices_mm, cut.faces, bulges[0].dome_mm))
        # The part beyond a cut may belong to the sac, where the sac touches its artery a second time.
        if part is not None and _holds(part, bulges[0]):
            lumen = part
            cuts.append(_Cut(center, radius, sense))
    if not cuts:
        return vessel
    inlet_mm, told = _inlets_of(vessel, _ends_mm(vessel, cuts, lumen), lumen)
    notes = (*vessel.notes, *_trimmed(site), *told, *_left_out(lumen, bulges[1:]))
    return trace(replace(vessel, lumen=lumen, openings=(), centerlines=(), notes=notes), inlet_mm=inlet_mm)


def _ends_mm(vessel: Vessel, cuts: list[_Cut], lumen: Surface) -> Floats:
    """Return where the blood of each opening of the vessel passes an end of the trimmed lumen, (k, 3), in mm."""
    # This is the first cut along the opening's centerline, or the cut upstream of the sac for an opening beyond that.
    loops = cKDTree(lumen.loop_centers_mm)
    before = [cut.center_mm for cut in cuts if cut.sense < 0]
    ahead = [cut for cut in cuts if cut.sense > 0]
    centers_mm = np.array([cut.center_mm for cut in ahead]).reshape(-1, 3)
    ends_mm = [before[0] if before else vessel.inlet.center_mm]
    for opening, line in zip(vessel.far_ends, vessel.centerlines, strict=True):
        place_mm, off_mm = curves.project(line.points_mm, centers_mm)
        through = np.flatnonzero(off_mm < [cut.radius_mm for cut in ahead])
        is_left = loops.query(opening.center_mm)[0] < STILL * opening.diameter_mm
        first = centers_mm[through[np.argsort(place_mm[through])]]
        passed = [*first, *([] if is_left else before), opening.center_mm]
        ends_mm.append(passed[0])
    return np.array(ends_mm)


def _inlets_of(vessel: Vessel, ends_mm: Floats, lumen: Surface) -> tuple[Floats, list[str]]:
    """Return the centers (i, 3) of a lumen's inlets, and notes on inlets of the vessel that were cut off."""
    loop = np.asarray(cKDTree(lumen.loop_centers_mm).query(ends_mm)[1])
    brought = np.bincount(loop, np.concatenate([murray_shares(vessel.inlets), -murray_shares(vessel.outlets)]))
    of_inlets = dict.fromkeys(loop[: len(vessel.inlets)].tolist())
    inlets = [k for k in of_inlets if k == loop[0] or brought[k] > 0]
    told = [
        f"{opening.role}, {opening.described}, was cut off: "
        f"{'its blood enters elsewhere' if k in inlets else 'that cut is an outlet now'}."
        for n, (opening, k) in enumerate(zip(vessel.inlets, loop, strict=False))
        if k in loop[:n] or k not in inlets
    ]
    return lumen.loop_centers_mm[inlets], told


def _holds(lumen: Surface, bulge: Bulge) -> bool:
    """Return whether a lumen still has all vertices of a bulge."""
    return bool(np.asarray(cKDTree(lumen.vertices_mm).query(bulge.points_mm)[0]).max() < SAME_MM)


def _refuse_none(*lengths_mm: float | None) -> None:
    """Raise an InputError for lengths that are not above zero."""
    for length_mm in lengths_mm:
        if length_mm is not None and not 0 < length_mm < np.inf:
            raise InputError(
                f"the artery cannot be trimmed to {length_mm:g} mm beside the sac: give a length above zero"
            )


def _trimmed(site: _Site) -> list[str]:
    """Return notes on the lengths that are kept."""
    before, beyond = site.before, site.beyond
    return [
        f"Trimmed to {before.kept_mm:.4g} mm of vessel proximal and {beyond.kept_mm:.4g} mm distal to the "
        "middle of the sac.",
        *(
            f"{way.kept_mm:.4g} mm are kept {way.side} the middle of the sac instead of {way.usual_mm:g}, "
            f"because the neck extends {way.neck_mm:.1f} mm from there."
            for way in (before, beyond)
            if way.has_grown
        ),
    ]


def _left_out(lumen: Surface, bulges: list[Bulge]) -> list[str]:
    """Return notes on sacs that were cut off."""
    return [
        f"Another bulge, {bulge.height_mm:.1f} mm high at {place(bulge.dome_mm)}, was cut off; choose it by "
        "that point (--at)."
        for bulge in bulges
        if lumen.closest(bulge.dome_mm[None])[1][0] > bulge.height_mm / 2
    ]


def _site(vessel: Vessel, bulge: Bulge, upstream_mm: float | None, downstream_mm: float | None) -> _Site:
    """Return the position of a sac on its artery and the lengths to keep; raise an InputError if one is too short."""
    foot = cKDTree(bulge.foot_mm)
    gaps = [np.asarray(foot.query(line.points_mm)[0]) for line in vessel.centerlines]
    parent = vessel.centerlines[int(np.argmin([gap.min() for gap in gaps]))]
    foot_mm = parent.nearest_abscissa_mm(bulge.foot_mm)
    sac_mm = float(foot_mm.mean())
    radius_mm = parent_radius_mm(parent.abscissa_mm, parent.inscribed_radius_mm)
    clear_mm = float(np.interp(sac_mm, parent.abscissa_mm, radius_mm))
    first_mm, last_mm = float(sac_mm - foot_mm.min()), float(foot_mm.max() - sac_mm)
    beyond_mm = parent.length_mm - sac_mm
    before = _Way("before", "--upstream", UPSTREAM_MM, upstream_mm, first_mm, clear_mm, sac_mm)
    beyond = _Way("beyond", "--downstream", DOWNSTREAM_MM, downstream_mm, last_mm, clear_mm, beyond_mm)
    for way in (before, beyond):
        if way.is_short and not way.has_grown:
            raise InputError(_short(way, bulge))
    return _Site(parent, sac_mm, before, beyond)


def _short(way: _Way, bulge: Bulge) -> str:
    """Return the error message for a length that is too short."""
    return (
        f"{way.asked_mm:g} mm of artery {way.side} the middle of the sac at "
        f"{place(bulge.foot_mm.mean(axis=0))} would be a cut through the sac or next to it, because its neck "
        f"extends {way.neck_mm:.1f} mm from there: give {way.option} {way.least_mm:.1f} or more"
    )


def _cuts(vessel: Vessel, site: _Site) -> list[tuple[Centerline, float, int]]:
    """Return for each cut its centerline, its abscissa, and the side to remove: behind (-1) or ahead (1)."""
    parent, sac_mm, before, beyond = site
    cuts = [(parent, sac_mm - before.kept_mm, -1)] if sac_mm > before.kept_mm + before.spare_mm else []
    for line in vessel.centerlines:
        fork_mm = min(_fork_mm(line, parent), line.length_mm)
        # A branch that leaves upstream of the sac is measured from the sac back to its fork and then along the branch.
        way_mm = beyond.kept_mm
        abscissa_mm = sac_mm + way_mm if fork_mm >= sac_mm else 2 * fork_mm - sac_mm + way_mm
        root_mm = fork_mm + 4.0 * float(np.interp(fork_mm, line.abscissa_mm, line.inscribed_radius_mm))
        abscissa_mm = max(abscissa_mm, root_mm) if line is not parent else abscissa_mm
        if line.length_mm > abscissa_mm + beyond.spare_mm:
            cuts.append((line, abscissa_mm, 1))
    return cuts


def _fork_mm(line: Centerline, parent: Centerline) -> float:
    """Return the abscissa where a centerline leaves that of the parent artery; its length for the parent itself."""
    apart = np.flatnonzero(curves.project(parent.points_mm, line.points_mm)[1] > line.inscribed_radius_mm)
    return float(line.abscissa_mm[apart[0]]) if len(apart) else line.length_mm
