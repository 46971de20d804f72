"""Trim the vessel to what the device and the flow need: a stated length of artery on both sides of the sac.

A scan shows the whole tree; blood far from the sac costs time and tells nothing. Every way out of the sac's
neighbourhood is cut square to its centerline where it has run the stated length, branches included.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from vstent.errors import InputError
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats
from vstent.openings import cut_square
from vstent.restore.bulges import Bulge, find_bulges
from vstent.restore.tubes import tubes_of
from vstent.surface import Surface
from vstent.trace import parent_radius_mm, trace
from vstent.vessel import Centerline, Vessel

UPSTREAM_MM: Final = 35.0
"""Length of artery kept before the sac's middle: half of the longest device, five diameters for the flow to develop."""
DOWNSTREAM_MM: Final = 25.0
"""Length of every way kept beyond the sac's middle."""
SPARE_MM: Final = 5.0
"""Nothing is cut for less than this."""
SAME_MM: Final = 1e-6
"""Vertices nearer than this are the same."""
STRIDE_MM: Final = 1.0
"""The direction of a cut is that of the centerline over this length."""


class _Kept(NamedTuple):
    """What is kept of the artery."""

    upstream_mm: float
    """Length before the sac's middle."""
    downstream_mm: float
    """Length of every way beyond it."""
    spare_mm: tuple[float, float]
    """Nothing is cut for less than this, before and beyond the sac."""


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
        When a length is not above zero, or so short that the cut would come within an artery's radius of the sac.
    """
    kept = _kept(upstream_mm, downstream_mm)
    bulges = find_bulges(vessel.lumen, tubes_of(vessel.centerlines), at_mm)
    if not bulges:
        return vessel
    lumen, inlet_mm = vessel.lumen, vessel.inlet.center_mm
    for line, abscissa_mm, sense in _cuts(vessel, bulges[0], kept):
        center, ahead = line.at(np.array([abscissa_mm, abscissa_mm + sense * STRIDE_MM]))
        direction = (ahead - center) / np.linalg.norm(ahead - center)
        radius = float(np.interp(abscissa_mm, line.abscissa_mm, line.inscribed_radius_mm))
        cut = cut_square(lumen, center, direction, radius)
        part = None if cut is None else Surface(*triangles.part_at(cut.vertices_mm, cut.faces, bulges[0].dome_mm))
        # What lies beyond a cut may hang on the sac as well, where the sac touches its artery a second time.
        if part is not None and _holds(part, bulges[0]):
            lumen = part
            inlet_mm = center if sense < 0 else inlet_mm
    if lumen is vessel.lumen:
        return vessel
    note = f"Trimmed to {kept.upstream_mm:.4g} mm of vessel before the sac's middle and {kept.downstream_mm:.4g} mm "
    note += "beyond it, cut square."
    notes = (*vessel.notes, note, *_left_out(lumen, bulges[1:]))
    return trace(replace(vessel, lumen=lumen, openings=(), centerlines=(), notes=notes), inlet_mm=inlet_mm)


def _holds(lumen: Surface, bulge: Bulge) -> bool:
    """Tell whether a lumen still has all of a bulge's vertices."""
    return bool(np.asarray(cKDTree(lumen.vertices_mm).query(bulge.points_mm)[0]).max() < SAME_MM)


def _kept(upstream_mm: float | None, downstream_mm: float | None) -> _Kept:
    given = [length_mm for length_mm in (upstream_mm, downstream_mm) if length_mm is not None]
    if not all(0 < length_mm < np.inf for length_mm in given):
        raise InputError(f"the artery cannot be trimmed to {given[0]:g} mm beside the sac: give a length above zero")
    return _Kept(
        UPSTREAM_MM if upstream_mm is None else upstream_mm,
        DOWNSTREAM_MM if downstream_mm is None else downstream_mm,
        (SPARE_MM if upstream_mm is None else 0.0, SPARE_MM if downstream_mm is None else 0.0),
    )


def _left_out(lumen: Surface, bulges: list[Bulge]) -> list[str]:
    """Sentences on the sacs that are not in what is left of the lumen."""
    return [
        f"Another sac, {bulge.height_mm:.1f} mm high, lies beyond that at "
        f"{', '.join(f'{x:.1f}' for x in bulge.dome_mm)} mm: give it with --at."
        for bulge in bulges
        if lumen.closest(bulge.dome_mm[None])[1][0] > bulge.height_mm / 2
    ]


def _cuts(vessel: Vessel, bulge: Bulge, kept: _Kept) -> list[tuple[Centerline, float, int]]:
    """Where to cut: a centerline, the abscissa on it, and whether the part behind (-1) or ahead (1) comes off."""
    foot = cKDTree(bulge.foot_mm)
    gaps = [np.asarray(foot.query(line.points_mm)[0]) for line in vessel.centerlines]
    main = int(np.argmin([gap.min() for gap in gaps]))
    parent = vessel.centerlines[main]
    sac_mm = float(parent.nearest_abscissa_mm(bulge.foot_mm).mean())
    _refuse_short(parent, bulge, sac_mm, kept)
    cuts = [(parent, sac_mm - kept.upstream_mm, -1)] if sac_mm > kept.upstream_mm + kept.spare_mm[0] else []
    for line in vessel.centerlines:
        fork_mm = min(_fork_mm(line, parent), line.length_mm)
        # A branch that leaves before the sac has run from the sac back to its fork already.
        way_mm = kept.downstream_mm
        abscissa_mm = sac_mm + way_mm if fork_mm >= sac_mm else 2 * fork_mm - sac_mm + way_mm
        root_mm = fork_mm + 4.0 * float(np.interp(fork_mm, line.abscissa_mm, line.inscribed_radius_mm))
        abscissa_mm = max(abscissa_mm, root_mm) if line is not parent else abscissa_mm
        if line.length_mm > abscissa_mm + kept.spare_mm[1]:
            cuts.append((line, abscissa_mm, 1))
    return cuts


def _refuse_short(parent: Centerline, bulge: Bulge, sac_mm: float, kept: _Kept) -> None:
    """Refuse lengths from the sac's middle, at `sac_mm`, with which a cut would come within a radius of its foot."""
    foot_mm = parent.nearest_abscissa_mm(bulge.foot_mm)
    radius_mm = parent_radius_mm(parent.abscissa_mm, parent.inscribed_radius_mm)
    clear_mm = float(np.interp(sac_mm, parent.abscissa_mm, radius_mm))
    sides = (
        ("before", "--upstream", kept.upstream_mm, sac_mm - foot_mm.min(), sac_mm),
        ("beyond", "--downstream", kept.downstream_mm, foot_mm.max() - sac_mm, parent.length_mm - sac_mm),
    )
    for side, option, length_mm, half_mm, whole_mm in sides:
        least_mm = half_mm + clear_mm
        if length_mm < min(least_mm, whole_mm):
            x, y, z = bulge.foot_mm.mean(axis=0)
            raise InputError(
                f"{length_mm:g} mm of artery {side} the middle of the sac at {x:.1f}, {y:.1f}, {z:.1f} mm would be cut "
                f"through the sac or beside it: its neck reaches {half_mm:.1f} mm from there; give {option} "
                f"{np.ceil(10 * least_mm) / 10:.1f} or more"
            )


def _fork_mm(line: Centerline, parent: Centerline) -> float:
    """Abscissa where a centerline leaves the parent's; its length for the parent itself."""
    apart = np.flatnonzero(curves.project(parent.points_mm, line.points_mm)[1] > line.inscribed_radius_mm)
    return float(line.abscissa_mm[apart[0]]) if len(apart) else line.length_mm
