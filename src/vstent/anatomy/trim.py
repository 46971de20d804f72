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
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline, Vessel, murray_shares
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats
from vstent.units import place

LISTED: Final = 3
"""Largest number of bulges that a note on those that were cut off lists."""
UPSTREAM_MM: Final = 35.0
"""Default length of artery upstream of the sac's middle, in mm: half of the longest device, and five diameters for the
flow to develop."""
DOWNSTREAM_MM: Final = 25.0
"""Default length in mm of every other artery, downstream of the sac's middle or to another inlet."""
SPARE_MM: Final = 5.0
"""By default, an artery is cut only if more than this length is removed, in mm."""
STRIDE_MM: Final = 1.0
"""Length in mm of the centerline that defines the direction of a cut."""


class _Way(NamedTuple):
    """The artery on one side of the sac's middle."""

    side: str
    """Name of the side: before or beyond the sac."""
    usual_mm: float
    """Default length to keep."""
    given_mm: float | None
    """Length given by the user; None for the default."""
    neck_mm: float
    """Distance from the sac's middle to the edge of the neck."""
    least_mm: float
    """Least length that clears the neck by a radius of the artery, rounded up to 0.1 mm."""
    is_short: bool
    """Whether a cut at the length to keep would be in the sac or too close to it."""

    @property
    def kept_mm(self) -> float:
        """Length to keep: as given, or the default or least length."""
        usual_mm = self.least_mm if self.is_short else self.usual_mm
        return usual_mm if self.given_mm is None else self.given_mm

    @property
    def spare_mm(self) -> float:
        """The artery is cut only if more than this length is removed."""
        return SPARE_MM if self.given_mm is None else 0.0


def trim(
    vessel: Vessel, *, at_mm: Floats | None = None, upstream_mm: float | None = None, downstream_mm: float | None = None
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
    for length_mm in (upstream_mm, downstream_mm):
        if length_mm is not None and not 0 < length_mm < np.inf:
            raise InputError(
                f"the artery cannot be trimmed to {length_mm:g} mm beside the sac: give a length above zero"
            )
    bulges = find_bulges(vessel.lumen, tubes_of(vessel.centerlines), at_mm)
    if not bulges:
        return vessel
    parent, sac_mm, before, beyond = _site(vessel, bulges[0], upstream_mm, downstream_mm)
    lumen = vessel.lumen
    cuts: list[tuple[Floats, float, int]] = []
    for line, abscissa_mm, sense in _cuts(vessel, parent, sac_mm, before, beyond):
        center, next_mm = line.at(np.array([abscissa_mm, abscissa_mm + sense * STRIDE_MM]))
        direction = (next_mm - center) / np.linalg.norm(next_mm - center)
        radius = float(np.interp(abscissa_mm, line.abscissa_mm, line.inscribed_radius_mm))
        cut = cut_square(lumen, center, direction, radius)
        if cut is None:
            continue
        part = Surface(*triangles.part_at(cut.vertices_mm, cut.faces, bulges[0].dome_mm))
        # The part beyond a cut may belong to the sac, where the sac touches its artery a second time.
        if np.asarray(cKDTree(part.vertices_mm).query(bulges[0].points_mm)[0]).max() < 1e-6:
            lumen = part
            cuts.append((center, radius, sense))
    if not cuts:
        return vessel
    inlet_mm, inlet_notes = _inlets_of(vessel, cuts, lumen)
    lost = [one for one in bulges[1:] if lumen.closest(one.dome_mm[None])[1][0] > one.height_mm / 2]
    notes = (*vessel.notes, *_notes(before, beyond, place(bulges[0].dome_mm), lost), *inlet_notes)
    return trace(replace(vessel, lumen=lumen, openings=(), centerlines=(), notes=notes), inlet_mm=inlet_mm)


def _notes(before: _Way, beyond: _Way, at: str, lost: list[Bulge]) -> list[str]:
    """Return notes on the lengths that are kept beside a bulge, and on the bulges that are cut off."""
    trimmed = (
        f"Trimmed to {before.kept_mm:.4g} mm of vessel proximal and {beyond.kept_mm:.4g} mm distal to the "
        f"middle of the bulge at {at}."
    )
    longer = [
        f"{way.kept_mm:.4g} mm are kept {way.side} the middle of the bulge instead of {way.usual_mm:g}, "
        f"because the neck extends {way.neck_mm:.1f} mm from there."
        for way in (before, beyond)
        if way.is_short
    ]
    highest = sorted(lost, key=lambda bulge: -bulge.height_mm)[:LISTED]
    places = ", ".join(f"{bulge.height_mm:.1f} mm at {place(bulge.dome_mm)}" for bulge in highest)
    cut = f"Other bulges that were cut off: {len(lost)}, the highest {places}. Choose one by its point (--at)."
    return [trimmed, *longer, *([cut] if lost else [])]


def _inlets_of(vessel: Vessel, cuts: list[tuple[Floats, float, int]], lumen: Surface) -> tuple[Floats, list[str]]:
    """Return the centers (i, 3) of a trimmed lumen's inlets, and notes on inlets of the vessel that were cut off.

    The cuts are center, radius, and the side that is removed, as in `_cuts`.
    """
    # The blood of an opening passes the first cut along its centerline, or the cut upstream of the sac beyond that.
    loops = cKDTree(lumen.loop_centers_mm)
    behind_mm = [center for center, _, sense in cuts if sense < 0]
    ahead = [(center, radius) for center, radius, sense in cuts if sense > 0]
    centers_mm = np.array([center for center, _ in ahead]).reshape(-1, 3)
    ends_mm = [[*behind_mm, vessel.inlet.center_mm][0]]
    for opening, line in zip(vessel.far_ends, vessel.centerlines, strict=True):
        place_mm, off_mm = curves.project(line.points_mm, centers_mm)
        through = np.flatnonzero(off_mm < [radius for _, radius in ahead])
        is_left = loops.query(opening.center_mm)[0] < STILL * opening.diameter_mm
        first = centers_mm[through[np.argsort(place_mm[through])]]
        ends_mm.append([*first, *([] if is_left else behind_mm), opening.center_mm][0])
    loop = np.asarray(cKDTree(lumen.loop_centers_mm).query(np.array(ends_mm))[1])
    brought = np.bincount(loop, np.concatenate([murray_shares(vessel.inlets), -murray_shares(vessel.outlets)]))
    of_inlets = dict.fromkeys(loop[: len(vessel.inlets)].tolist())
    inlets = [k for k in of_inlets if k == loop[0] or brought[k] > 0]
    notes = [
        f"{opening.role}, {opening.described}, was cut off: "
        f"{'its blood enters elsewhere' if k in inlets else 'that cut is an outlet now'}."
        for n, (opening, k) in enumerate(zip(vessel.inlets, loop, strict=False))
        if k in loop[:n] or k not in inlets
    ]
    return lumen.loop_centers_mm[inlets], notes


def _site(
    vessel: Vessel, bulge: Bulge, upstream_mm: float | None, downstream_mm: float | None
) -> tuple[Centerline, float, _Way, _Way]:
    """Return the centerline of a sac's artery, the abscissa of the sac's middle, and the artery on both sides of it.

    Raise an InputError if a given length is too short.
    """
    foot = cKDTree(bulge.foot_mm)
    gaps = [np.asarray(foot.query(line.points_mm)[0]) for line in vessel.centerlines]
    parent = vessel.centerlines[int(np.argmin([gap.min() for gap in gaps]))]
    foot_mm = parent.nearest_abscissa_mm(bulge.foot_mm)
    sac_mm = float(foot_mm.mean())
    radius_mm = parent_radius_mm(parent.abscissa_mm, parent.inscribed_radius_mm)
    clear_mm = float(np.interp(sac_mm, parent.abscissa_mm, radius_mm))
    ways = []
    for side, option, usual_mm, given_mm, neck_mm, whole_mm in (
        ("before", "--upstream", UPSTREAM_MM, upstream_mm, float(sac_mm - foot_mm.min()), sac_mm),
        (
            "beyond",
            "--downstream",
            DOWNSTREAM_MM,
            downstream_mm,
            float(foot_mm.max() - sac_mm),
            parent.length_mm - sac_mm,
        ),
    ):
        least_mm = float(np.ceil(10 * (neck_mm + clear_mm)) / 10)
        is_short = (usual_mm if given_mm is None else given_mm) < min(neck_mm + clear_mm, whole_mm)
        if is_short and given_mm is not None:
            raise InputError(
                f"{given_mm:g} mm of artery {side} the middle of the sac at "
                f"{place(bulge.foot_mm.mean(axis=0))} would be a cut through the sac or next to it, because its neck "
                f"extends {neck_mm:.1f} mm from there: give {option} {least_mm:.1f} or more"
            )
        ways.append(_Way(side, usual_mm, given_mm, neck_mm, least_mm, is_short))
    return parent, sac_mm, ways[0], ways[1]


def _cuts(
    vessel: Vessel, parent: Centerline, sac_mm: float, before: _Way, beyond: _Way
) -> list[tuple[Centerline, float, int]]:
    """Return for each cut its centerline, its abscissa, and the side to remove: behind (-1) or ahead (1)."""
    cuts = [(parent, sac_mm - before.kept_mm, -1)] if sac_mm > before.kept_mm + before.spare_mm else []
    for line in vessel.centerlines:
        apart = np.flatnonzero(curves.project(parent.points_mm, line.points_mm)[1] > line.inscribed_radius_mm)
        fork_mm = float(line.abscissa_mm[apart[0]]) if len(apart) else line.length_mm
        # A branch that leaves upstream of the sac is measured from the sac back to its fork and then along the branch.
        way_mm = beyond.kept_mm
        abscissa_mm = sac_mm + way_mm if fork_mm >= sac_mm else 2 * fork_mm - sac_mm + way_mm
        root_mm = fork_mm + 4.0 * float(np.interp(fork_mm, line.abscissa_mm, line.inscribed_radius_mm))
        abscissa_mm = max(abscissa_mm, root_mm) if line is not parent else abscissa_mm
        if line.length_mm > abscissa_mm + beyond.spare_mm:
            cuts.append((line, abscissa_mm, 1))
    return cuts
