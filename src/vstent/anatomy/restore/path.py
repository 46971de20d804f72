"""Choose the centerline of the parent artery: past the sac to an outlet, along the wider branch at every fork."""

from functools import reduce
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from vstent.anatomy.restore.bulges import Bulge
from vstent.anatomy.trace import parent_radius_mm
from vstent.geometry.vessel import Centerline, Vessel
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats

REACH_MM: Final = 10.0
"""Length beyond a fork, in mm, over which the widths of two branches are compared."""
IN_SAC: Final = 1.2
"""An inscribed sphere reaches into a sac if the sac's wall is within this many of its radii."""
BACK_RAD: Final = np.radians(100.0)
"""A path that turns by more than this angle, in rad, at a fork turns back: it runs into the other of two arteries that
join there."""
BACK: Final = 0.8
"""Factor on the width of a path that turns back: both joining arteries feed the third, and are at most about as wide as
it (Murray 1926)."""
SHARED: Final = 2.0
"""Two centerlines share their course up to this many radii before the point where they part."""
PASSING: Final = 2.0
"""A centerline passes a bulge whose foot is within this many parent radii; the wall of a bulge begins at 1.5."""


def parent_path(vessel: Vessel, bulges: list[Bulge], outlet_mm: Floats | None) -> int:
    """Return the index of the centerline that the parent artery follows; it ends nearest to `outlet_mm` (3,)."""
    lines = vessel.centerlines
    if outlet_mm is not None:
        ends = np.array([opening.center_mm for opening in vessel.far_ends])
        return int(np.argmin(np.linalg.norm(ends - np.asarray(outlet_mm), axis=1)))
    leads_out = [not opening.is_inlet for opening in vessel.far_ends]
    reach = np.array([reach_of(line, bulges[0]) if bulges else 0.0 for line in lines])
    reach = np.where(leads_out, reach, np.inf)
    passing = np.flatnonzero(reach <= max(PASSING, 1.25 * reach.min()))
    off = [is_off_sacs(line, bulges[:1]) for line in lines]

    def wider(i: int, k: int) -> int:
        widths = _width_beyond_fork(lines[i], lines[k], off[i]), _width_beyond_fork(lines[k], lines[i], off[k])
        return i if widths[0] >= widths[1] else k

    return reduce(wider, passing.tolist())


def is_off_sacs(line: Centerline, bulges: list[Bulge]) -> Bools:
    """Return whether each point of a centerline has an inscribed sphere that no bulge widens."""
    off = np.ones(len(line.points_mm), dtype=bool)
    for bulge in bulges:
        off &= bulge.distances_mm(line.points_mm) > IN_SAC * line.inscribed_radius_mm
    return off


def reach_of(line: Centerline, bulge: Bulge) -> float:
    """Return the smallest distance from a centerline to a bulge's foot, in parent radii."""
    radius = parent_radius_mm(line.abscissa_mm, line.inscribed_radius_mm)
    return float((cKDTree(bulge.foot_mm).query(line.points_mm)[0] / radius).min())


def _width_beyond_fork(line: Centerline, other: Centerline, is_off: Bools) -> float:
    """Return the median radius of a centerline over `REACH_MM` beyond its fork; 0 where it parts in the sac only."""
    distance = curves.project(other.points_mm, line.points_mm)[1]
    apart = np.flatnonzero((distance > line.inscribed_radius_mm) & is_off)
    if not len(apart):
        return 0.0
    fork_mm = line.abscissa_mm[apart[0]]
    beyond = (line.abscissa_mm >= fork_mm) & (line.abscissa_mm <= fork_mm + REACH_MM)
    # A path that is mostly in the sac leads to a branch of the sac. The width of the sac is not that of the branch.
    own = beyond & is_off if (beyond & is_off).sum() < 0.5 * beyond.sum() else beyond
    # Centerlines part where one leaves the inscribed sphere of the other, some distance beyond the fork.
    shared_mm = float(fork_mm) - SHARED * float(np.interp(fork_mm, line.abscissa_mm, line.inscribed_radius_mm))
    places_mm = np.array([shared_mm - REACH_MM, shared_mm, fork_mm, fork_mm + REACH_MM])
    before, _, after = np.diff(line.at(np.clip(places_mm, 0.0, line.length_mm)), axis=0)
    turns_back = before @ after < np.cos(BACK_RAD) * np.linalg.norm(before) * np.linalg.norm(after)
    return (BACK if turns_back else 1.0) * float(np.median(line.inscribed_radius_mm[own]))
