"""Find bulges: connected parts of the wall that rise above the tubes and may be sacs."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from vstent.anatomy.restore.tubes import Tubes
from vstent.geometry.surface import Surface
from vstent.kernels import triangles
from vstent.kernels.arrays import Bools, Floats, Ints, freeze

FLANK: Final = 0.5
"""A bulge is wall that rises above the tubes by more than this many parent radii."""
HEIGHT: Final = 1.0
"""Smallest height of a sac above the tubes, in parent radii."""
HEIGHT_MM: Final = 1.5
"""Smallest height of a sac above the tubes, in mm."""
LOW_MM: Final = 1.0
"""Lower bulges, in mm, are uneven wall and are not reported."""
SHOULDER: Final = 3.0
"""Largest distance, in parent radii, of a bulge's vertices from wall that is at least `HEIGHT` high. The wide sides of
an oval artery rise above round tubes along its whole length, but are not part of a sac on it."""
WIDTH: Final = 1.0
"""Smallest inner width of a sac, in parent radii; a thinner bulge is a small branch."""

LENGTH: Final = 3.5
"""A sac is lower than this many of its own widths; a higher bulge is a branch that ends blind."""


@dataclass(frozen=True, eq=False)
class Bulge:
    """Part of the lumen's wall that rises above the tubes."""

    points_mm: Floats
    """(n, 3) vertices of the bulge."""
    foot_mm: Floats
    """(k, 3) vertices at its edge, where it rises from the tubes. A sac may touch other arteries, but it arises at its
    foot."""
    dome_mm: Floats
    """(3,) highest vertex."""
    height_mm: float
    """Height of the highest vertex above the tubes."""
    width_mm: float = 0.0
    """Median depth of the lumen below its vertices; 0 where not measured."""

    def __post_init__(self) -> None:
        freeze(self, "points_mm foot_mm", np.float64, (-1, 3))
        freeze(self, "dome_mm", np.float64, (3,))

    @property
    def inward(self) -> Floats:
        """(3,) unit vector into the bulge, perpendicular to its foot: the dome may lie to the side of the mouth."""
        vector = triangles.polygon_area_vector(self.foot_mm)
        vector *= np.sign((self.points_mm.mean(axis=0) - self.foot_mm.mean(axis=0)) @ vector)
        return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))

    def distances_mm(self, points_mm: Floats) -> Floats:
        """Return the distance (k,) of points (k, 3) to the nearest vertex of the bulge, in mm."""
        return np.asarray(cKDTree(self.points_mm).query(points_mm)[0])


def find_bulges(lumen: Surface, tubes: Tubes, at_mm: Floats | None = None) -> list[Bulge]:
    """Find the sacs on the lumen's wall, the largest first; with a point (3,), the bulge nearest to it."""
    bulges = _all_bulges(lumen, tubes)
    if at_mm is None:
        return _largest_first([bulge for bulge, is_high, is_wide in bulges if is_high and is_wide])
    point = np.asarray(at_mm, dtype=np.float64)[None]
    away_mm = [(float(bulge.distances_mm(point)[0]), bulge) for bulge, *_ in bulges]
    near = [(gap_mm, bulge) for gap_mm, bulge in away_mm if gap_mm < max(2.0 * bulge.height_mm, 1.0)]
    return [bulge for _, bulge in sorted(near, key=lambda row: row[0])[:1]]


def flat_bulges(lumen: Surface, tubes: Tubes) -> list[Bulge]:
    """Return bulges that are as wide as sacs but too low, the largest first."""
    bulges = _all_bulges(lumen, tubes)
    return _largest_first([b for b, is_high, is_wide in bulges if is_wide and not is_high and b.height_mm > LOW_MM])


def _all_bulges(lumen: Surface, tubes: Tubes) -> list[tuple[Bulge, bool, bool]]:
    """Return all bulges on the lumen's wall, whether each is high enough for a sac, and whether it is wide enough."""
    height, sphere = tubes.height_mm(lumen.vertices_mm)
    parent = tubes.radius_mm[sphere]
    # Depth of the lumen below every vertex (Shapira et al. 2008, Visual Computer 24:249, one ray).
    inward = -lumen.vertex_normals
    depth = lumen.first_hit(lumen.vertices_mm + 1e-3 * inward, inward)
    thickness = np.where(np.isfinite(depth), depth, 0.0)
    found = []
    for member in _patches(lumen, height > FLANK * parent):
        typical = float(np.median(parent[member]))
        points, is_top = lumen.vertices_mm[member], height[member] / typical > HEIGHT
        if is_top.any():
            member = member[cKDTree(points[is_top]).query(points)[0] <= SHOULDER * typical]
        width_mm = max(float(np.median(thickness[member])), 1e-6)
        bulge = replace(_bulge(lumen, height, member), width_mm=width_mm)
        is_high = bulge.height_mm > max(HEIGHT * typical, HEIGHT_MM)
        # A bulge that is too high for its width is a branch that ends blind.
        found.append((bulge, is_high, width_mm > WIDTH * typical and bulge.height_mm < LENGTH * width_mm))
    return found


def _largest_first(bulges: list[Bulge]) -> list[Bulge]:
    """Return bulges ordered by the smaller of height and width: a branch stump is high, but not wide."""
    return sorted(bulges, key=lambda bulge: -min(bulge.height_mm, bulge.width_mm))


def bulge_at(lumen: Surface, height_mm: Floats, is_out: Bools, dome_mm: Floats) -> Bulge | None:
    """Return the connected part of the wall, of heights (n,), where `is_out` (n,) holds that contains a dome (3,)."""
    dome = int(np.argmin(np.linalg.norm(lumen.vertices_mm - dome_mm, axis=1)))
    patches = [member for member in _patches(lumen, is_out) if dome in member]
    return _bulge(lumen, height_mm, patches[0]) if patches else None


def _bulge(lumen: Surface, height_mm: Floats, member: Ints) -> Bulge:
    """Return the bulge with the given vertices."""
    top = member[np.argmax(height_mm[member])]
    inside = np.zeros(len(height_mm), dtype=bool)
    inside[member] = True
    points = lumen.vertices_mm
    # Where a sac touches another artery, the patch has a second, shorter edge.
    edges = triangles.boundary_loops(points, lumen.faces[inside[lumen.faces].all(axis=1)])
    return Bulge(points[member], points[edges[0] if edges else member], points[top], float(height_mm[top]))


def _patches(lumen: Surface, is_out: Bools) -> list[Ints]:
    """Return the vertices of each connected patch, of at least five vertices, where `is_out` (n,) holds."""
    edges = triangles.directed_edges(lumen.faces)
    edges = edges[is_out[edges].all(axis=1)]
    label = triangles.joined(edges, len(is_out))
    count = np.bincount(label[is_out], minlength=label.max() + 1)
    return [np.flatnonzero(is_out & (label == k)) for k in np.flatnonzero(count >= 5)]
