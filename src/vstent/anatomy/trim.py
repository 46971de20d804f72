"""Trim the vessel to what the device and the flow need: a stated length of artery on both sides of the sac.

A scan shows the whole tree; blood far from the sac costs time and tells nothing. Every way out of the sac's
neighbourhood is cut square to its centerline where it has run the stated length, branches included. Through a cut goes
what the openings beyond it brought or took: it is an inlet where, by Murray's law, they brought more.
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
"""Length of artery kept before the sac's middle: half of the longest device, five diameters for the flow to develop."""
DOWNSTREAM_MM: Final = 25.0
"""Length of every other way kept, beyond the sac's middle or to another inlet."""
SPARE_MM: Final = 5.0
"""Nothing is cut for less than this."""
SAME_MM: Final = 1e-6
"""Vertices nearer than this are the same."""
STRIDE_MM: Final = 1.0
"""The direction of a cut is that of the centerline over this length."""


class _Way(NamedTuple):
    """The artery on one side of the sac's middle."""

    side: str
    """Which: before or beyond the sac."""
    option: str
    """What gives the length to keep of it."""
    usual_mm: float
    """The length kept where none is given."""
    given_mm: float | None
    """The length given."""
    neck_mm: float
    """How far the sac's neck reaches."""
    clear_mm: float
    """A cut comes no nearer to the neck than this."""
    whole_mm: float
    """How long the artery is."""

    @property
    def asked_mm(self) -> float:
        """The length given, or the usual one."""
        return self.usual_mm if self.given_mm is None else self.given_mm

    @property
    def is_short(self) -> bool:
        """Whether that would cut the sac or beside it."""
        return self.asked_mm < min(self.neck_mm + self.clear_mm, self.whole_mm)

    @property
    def has_grown(self) -> bool:
        """Whether the usual length is too short, and the least is kept in its place."""
        return self.given_mm is None and self.is_short

    @property
    def least_mm(self) -> float:
        """The least length that clears the neck, in full tenths."""
        return float(np.ceil(10 * (self.neck_mm + self.clear_mm)) / 10)

    @property
    def kept_mm(self) -> float:
        """The length to keep."""
        return self.least_mm if self.has_grown else self.asked_mm

    @property
    def spare_mm(self) -> float:
        """Nothing is cut for less than this."""
        return SPARE_MM if self.given_mm is None else 0.0


class _Cut(NamedTuple):
    """Where the artery was cut."""

    center_mm: Floats
    """(3,) on a centerline."""
    radius_mm: float
    """Radius of the artery there."""
    sense: int
    """Whether the part behind (-1) or ahead (1) came off."""


class _Site(NamedTuple):
    """Where the sac hangs on its artery."""

    parent: Centerline
    """The artery's centerline."""
    sac_mm: float
    """Abscissa of the sac's middle on it."""
    before: _Way
    """The artery before it."""
    beyond: _Way
    """The artery beyond it."""


def trim(
    vessel: Vessel,
    *,
    at_mm: Floats | None = None,
    upstream_mm: float | None = None,
    downstream_mm: float | None = None,
) -> Vessel:
    """Return a traced vessel cut down around its highest sac, and traced anew.

    A vessel without a sac, or short enough, is returned as it is.

    Parameters
    ----------
    vessel : a vessel with centerlines.
    at_mm : (3,) a point near the sac to keep; the highest otherwise.
    upstream_mm : length of artery to keep before the sac's middle, above zero; 35 mm, and nothing is cut for less
        than 5 mm more, where it is not given.
    downstream_mm : length to keep of every way beyond the sac's middle, likewise; 25 mm where it is not given.

    Raises
    ------
    InputError
        When a length is not above zero, or so short that the cut would come within an artery's radius of the sac; one
        that is not given grows by what it needs, and a note says so.
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
        # What lies beyond a cut may hang on the sac as well, where the sac touches its artery a second time.
        if part is not None and _holds(part, bulges[0]):
            lumen = part
            cuts.append(_Cut(center, radius, sense))
    if not cuts:
        return vessel
    inlet_mm, told = _inlets_of(vessel, _ends_mm(vessel, cuts, lumen), lumen)
    notes = (*vessel.notes, *_trimmed(site), *told, *_left_out(lumen, bulges[1:]))
    return trace(replace(vessel, lumen=lumen, openings=(), centerlines=(), notes=notes), inlet_mm=inlet_mm)


def _ends_mm(vessel: Vessel, cuts: list[_Cut], lumen: Surface) -> Floats:
    """Where (k, 3) the blood of every opening of a vessel passes an end of what the cuts leave of it, the lumen.

    That is the first cut along the opening's centerline; the one before the sac, where it lies behind that.
    """
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
    """Middles (i, 3) of a lumen's inlets, and sentences on those of the vessel that are no openings of their own.

    Blood of each opening of the vessel passes an end of the lumen at `ends_mm` (k, 3).
    """
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
    """Tell whether a lumen still has all of a bulge's vertices."""
    return bool(np.asarray(cKDTree(lumen.vertices_mm).query(bulge.points_mm)[0]).max() < SAME_MM)


def _refuse_none(*lengths_mm: float | None) -> None:
    """Refuse lengths that are not above zero."""
    for length_mm in lengths_mm:
        if length_mm is not None and not 0 < length_mm < np.inf:
            raise InputError(
                f"the artery cannot be trimmed to {length_mm:g} mm beside the sac: give a length above zero"
            )


def _trimmed(site: _Site) -> list[str]:
    """Sentences on what is kept."""
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
    """Sentences on the sacs that are not in what is left of the lumen."""
    return [
        f"Another bulge, {bulge.height_mm:.1f} mm high at {place(bulge.dome_mm)}, was cut off; choose it by "
        "that point (--at)."
        for bulge in bulges
        if lumen.closest(bulge.dome_mm[None])[1][0] > bulge.height_mm / 2
    ]


def _site(vessel: Vessel, bulge: Bulge, upstream_mm: float | None, downstream_mm: float | None) -> _Site:
    """Where a sac hangs on its artery, and what is to be kept of it on both sides: the lengths given, if any.

    Raises
    ------
    InputError
        When with a length given a cut would come within a radius of the sac's foot.
    """
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
    return (
        f"{way.asked_mm:g} mm of artery {way.side} the middle of the sac at "
        f"{place(bulge.foot_mm.mean(axis=0))} would be a cut through the sac or next to it, because its neck "
        f"extends {way.neck_mm:.1f} mm from there: give {way.option} {way.least_mm:.1f} or more"
    )


def _cuts(vessel: Vessel, site: _Site) -> list[tuple[Centerline, float, int]]:
    """Where to cut: a centerline, the abscissa on it, and whether the part behind (-1) or ahead (1) comes off."""
    parent, sac_mm, before, beyond = site
    cuts = [(parent, sac_mm - before.kept_mm, -1)] if sac_mm > before.kept_mm + before.spare_mm else []
    for line in vessel.centerlines:
        fork_mm = min(_fork_mm(line, parent), line.length_mm)
        # A branch that leaves before the sac has run from the sac back to its fork already.
        way_mm = beyond.kept_mm
        abscissa_mm = sac_mm + way_mm if fork_mm >= sac_mm else 2 * fork_mm - sac_mm + way_mm
        root_mm = fork_mm + 4.0 * float(np.interp(fork_mm, line.abscissa_mm, line.inscribed_radius_mm))
        abscissa_mm = max(abscissa_mm, root_mm) if line is not parent else abscissa_mm
        if line.length_mm > abscissa_mm + beyond.spare_mm:
            cuts.append((line, abscissa_mm, 1))
    return cuts


def _fork_mm(line: Centerline, parent: Centerline) -> float:
    """Abscissa where a centerline leaves the parent's; its length for the parent itself."""
    apart = np.flatnonzero(curves.project(parent.points_mm, line.points_mm)[1] > line.inscribed_radius_mm)
    return float(line.abscissa_mm[apart[0]]) if len(apart) else line.length_mm
