"""Cut the wall along a neck drawn by hand: the part separated from the inlet is the sac."""

from typing import Final, NamedTuple

import numpy as np

from vstent.anatomy.restore.bulges import FLANK, Bulge, bulge_at
from vstent.anatomy.restore.tubes import tubes_of
from vstent.errors import InputError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats, Ints
from vstent.units import place

FAR_MM: Final = 1.5
"""Largest distance of a drawn neck from the wall, in mm; a farther curve belongs to another vessel."""
STEP_EDGES: Final = 0.25
"""Spacing of the points on the curve, in edge lengths of the mesh."""
RIBBON_EDGES: Final = 1.5
"""Half width of the ribbon along the curve that cuts the wall, in edge lengths of the mesh."""
FEWEST_VERTICES: Final = 12
"""Fewest vertices in the wall of a sac."""


class Drawn(NamedTuple):
    """Wall of a vessel, cut along a drawn neck."""

    vertices_mm: Floats
    """(n, 3) vertices of the sac's wall."""
    faces: Ints
    """(m, 3) vertex indices of its faces."""
    artery: Surface
    """The remaining wall."""
    bulge: Bulge
    """Part of the sac's wall that rises above the tubes around all centerlines; its foot is where that part begins."""
    neck_mm: Floats
    """(k, 3) evenly spaced points of the neck; points drawn outside the lumen are moved onto the wall."""
    cut_mm: Floats
    """(k, 3) points of the wall nearest to the points of `neck_mm`."""

    def neck_of(self, rim_mm: Floats) -> Floats:
        """Return the points (j, 3) of the neck that belong to successive points (j, 3) along the cut."""
        ring = np.concatenate([self.cut_mm, self.cut_mm[:1]])
        place = curves.arc_length(ring)
        turn = np.unwrap(curves.project(ring, rim_mm)[0] / place[-1], period=1.0)
        turn = np.maximum.accumulate(turn) if turn[-1] > turn[0] else np.minimum.accumulate(turn)
        return curves.interpolate(
            place / place[-1], np.concatenate([self.neck_mm, self.neck_mm[:1]]), np.mod(turn, 1.0)
        )


def cut_along(vessel: Vessel, neck_mm: Floats) -> Drawn:
    """Cut the wall along a neck (k, 3) drawn by hand; an InputError says what is wrong with the neck."""
    given = np.asarray(neck_mm, dtype=np.float64)
    if given.ndim != 2 or given.shape[1] != 3 or len(given) < 3 or not np.isfinite(given).all():
        raise InputError(
            "the neck is not a closed curve: give at least three points with three coordinates each, in mm"
        )
    lumen = vessel.lumen
    corners = lumen.corners_mm
    edge_mm = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    ring = np.concatenate([given, given[:1]])
    n = max(32, round(float(curves.arc_length(ring)[-1]) / (STEP_EDGES * edge_mm)))
    even = curves.resample_evenly(ring, n + 1)[:-1]
    cut, off_mm, _ = lumen.closest(even)
    worst = int(off_mm.argmax())
    if off_mm[worst] > FAR_MM:
        raise InputError(
            f"the neck is {off_mm[worst]:.1f} mm from the wall at {place(even[worst])}: draw it within "
            f"{FAR_MM:g} mm of the wall"
        )
    level = _level_mm(vessel, cut, RIBBON_EDGES * edge_mm)
    sac, artery = (triangles.clip(lumen.vertices_mm, lumen.faces, side * level)[:2] for side in (1.0, -1.0))
    neck = np.where((vessel.closed.signed_distance(even) < 0)[:, None], even, cut)
    # Wall that belongs to a branch according to the centerlines does not bulge.
    tubes, is_sac = tubes_of(vessel.centerlines), level < 0
    height, sphere = tubes.height_mm(lumen.vertices_mm)
    height = np.where(is_sac, height, -np.inf)
    dome, points = lumen.vertices_mm[height.argmax()], lumen.vertices_mm[is_sac]
    bulge = bulge_at(lumen, height, height > FLANK * tubes.radius_mm[sphere], dome)
    return Drawn(*sac, Surface(*artery), bulge or Bulge(points, points, dome, float(height.max())), neck, cut)


def _level_mm(vessel: Vessel, curve_mm: Floats, reach_mm: float) -> Floats:
    """Return the distance (n,) of the wall's vertices from the curve (k, 3), in mm; negative on the sac's side."""
    lumen = vessel.lumen
    # A ribbon perpendicular to the wall along the curve.
    across = reach_mm * curves.lowpass(
        lumen.normals[lumen.closest(curve_mm)[2]], triangles.perimeter(curve_mm) / (4.0 * reach_mm)
    )
    n = len(curve_mm)
    here, there = np.arange(n), (np.arange(n) + 1) % n
    strips = [np.stack([here, there, n + there], axis=1), np.stack([here, n + there, n + here], axis=1)]
    ribbon = Surface(np.concatenate([curve_mm - across, curve_mm + across]), np.concatenate(strips))
    edges = triangles.directed_edges(lumen.faces)
    ends = lumen.vertices_mm[edges]
    distance = ribbon.closest(lumen.vertices_mm)[1]
    near = np.flatnonzero(distance[edges].min(axis=1) < np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))
    is_crossed = np.zeros(len(edges), dtype=bool)
    is_crossed[near] = ribbon.crosses(ends[near, 0], ends[near, 1])
    label = triangles.joined(edges[~is_crossed], len(lumen.vertices_mm))
    at_end = [label[int(np.linalg.norm(lumen.vertices_mm - end.center_mm, axis=1).argmin())] for end in vessel.openings]
    # The sac is the largest part that is separated from the inlet.
    count = np.bincount(label)
    count[at_end[0]] = 0
    sac = int(count.argmax())
    if count[sac] < FEWEST_VERTICES:
        raise InputError(
            "the neck separates nothing from the artery: draw one closed curve around the mouth of the sac"
        )
    if sac in at_end[1:] and at_end[0] not in at_end[1:]:
        raise InputError("the neck runs around the artery itself: draw it around the mouth of the sac only")
    return np.where(label == sac, -distance, distance)
