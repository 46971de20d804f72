"""Bulges: connected pieces of wall that stand out of the tubes far enough to be a sac."""

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from vstent.anatomy.restore.tubes import Tubes
from vstent.geometry.surface import Surface
from vstent.kernels import triangles
from vstent.kernels.arrays import Bools, Floats, Ints, freeze

FLANK: Final = 0.5
"""A bulge is where the wall stands out by more than this many parent radii."""
HEIGHT: Final = 1.0
"""A sac stands out by at least this many parent radii..."""
HEIGHT_MM: Final = 1.5
"""... and by at least this much."""
LOW_MM: Final = 1.0
"""What stands out by less than this is an uneven wall, and not told."""
SHOULDER: Final = 3.0
"""A bulge goes no farther than this many parent radii from where it stands out by one: the wide sides of an oval
artery, which stand out of round tubes all along it, are no part of a sac on them."""
WIDTH: Final = 1.0
"""A sac is at least this many parent radii wide inside (its diameter); what is thinner is a twig."""

LENGTH: Final = 3.5
"""A sac stands out by less than this many of its own widths; what is longer is a branch that ends blind."""


@dataclass(frozen=True, eq=False)
class Bulge:
    """A piece of the lumen's wall that stands out of the tubes."""

    points_mm: Floats
    """(n, 3) its vertices."""
    foot_mm: Floats
    """(k, 3) those at its edge, where it rises from the tubes: a sac may touch other arteries, it hangs on its foot."""
    dome_mm: Floats
    """(3,) the vertex that stands out furthest."""
    height_mm: float
    """How far that is."""
    width_mm: float = 0.0
    """Median depth of the lumen below its vertices; 0 where it is not measured."""

    def __post_init__(self) -> None:
        freeze(self, "points_mm", np.float64, (-1, 3))
        freeze(self, "foot_mm", np.float64, (-1, 3))
        freeze(self, "dome_mm", np.float64, (3,))

    @property
    def inward(self) -> Floats:
        """(3,) unit vector square to the plane of its foot, into it: a sac may hang to the side of its mouth."""
        vector = triangles.polygon_area_vector(self.foot_mm)
        vector *= np.sign((self.points_mm.mean(axis=0) - self.foot_mm.mean(axis=0)) @ vector)
        return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))

    def distances_mm(self, points_mm: Floats) -> Floats:
        """Distance (k,) of each of (k, 3) points to the nearest vertex of the bulge."""
        return np.asarray(cKDTree(self.points_mm).query(points_mm)[0])


class _Standing(NamedTuple):
    """A bulge that may be a sac."""

    bulge: Bulge
    is_high: bool
    """It stands out far enough for a sac."""
    is_wide: bool
    """It is wide enough for one, and neither a twig nor a branch that ends blind."""


def find_bulges(lumen: Surface, tubes: Tubes, at_mm: Floats | None = None) -> list[Bulge]:
    """Sacs on the lumen's wall, the largest first; with `at_mm` (3,) only the bulge nearest to it, however flat."""
    found = _standing_out(lumen, tubes)
    if at_mm is None:
        return _largest_first([one.bulge for one in found if one.is_wide and one.is_high])
    point = np.asarray(at_mm, dtype=np.float64)[None]
    bulges = [one.bulge for one in found]
    near = [b for b in bulges if float(b.distances_mm(point)[0]) < max(2.0 * b.height_mm, 1.0)]
    return sorted(near, key=lambda bulge: float(bulge.distances_mm(point)[0]))[:1]


def flat_bulges(lumen: Surface, tubes: Tubes) -> list[Bulge]:
    """Bulges as wide as sacs on the lumen's wall that are too flat or too low for one, the largest first."""
    found = [one.bulge for one in _standing_out(lumen, tubes) if one.is_wide and not one.is_high]
    return _largest_first([bulge for bulge in found if bulge.height_mm > LOW_MM])


def _standing_out(lumen: Surface, tubes: Tubes) -> list[_Standing]:
    """All bulges on the lumen's wall."""
    height, sphere = tubes.height_mm(lumen.vertices_mm)
    parent = tubes.radius_mm[sphere]
    thickness = _thickness_mm(lumen)
    found = []
    for member in _patches(lumen, height > FLANK * parent):
        typical = float(np.median(parent[member]))
        member = _about_dome(lumen.vertices_mm[member], height[member] / typical, SHOULDER * typical, member)
        width_mm = max(float(np.median(thickness[member])), 1e-6)
        bulge = replace(_bulge(lumen, height, member), width_mm=width_mm)
        is_high = bulge.height_mm > max(HEIGHT * typical, HEIGHT_MM)
        found.append(_Standing(bulge, is_high, width_mm > WIDTH * typical and bulge.height_mm < LENGTH * width_mm))
    return found


def _largest_first(bulges: list[Bulge]) -> list[Bulge]:
    """Return bulges ordered by height or width, whichever is less: a stump is high, but not wide."""
    return sorted(bulges, key=lambda bulge: -min(bulge.height_mm, bulge.width_mm))


def _about_dome(points_mm: Floats, rise: Floats, reach_mm: float, member: Ints) -> Ints:
    """Those of a patch's vertices (n,) that lie within a reach of ones as high as a sac's; all where none is."""
    is_high = rise > HEIGHT
    if not is_high.any():
        return member
    return np.asarray(member[cKDTree(points_mm[is_high]).query(points_mm)[0] <= reach_mm])


def bulge_at(lumen: Surface, height_mm: Floats, is_out: Bools, dome_mm: Floats) -> Bulge | None:
    """The connected patch of wall where `is_out` (n,) holds that reaches `dome_mm` (3,); None where it does not."""
    dome = int(np.argmin(np.linalg.norm(lumen.vertices_mm - dome_mm, axis=1)))
    patches = [member for member in _patches(lumen, is_out) if dome in member]
    return _bulge(lumen, height_mm, patches[0]) if patches else None


def _bulge(lumen: Surface, height_mm: Floats, member: Ints) -> Bulge:
    top = member[np.argmax(height_mm[member])]
    inside = np.zeros(len(height_mm), dtype=bool)
    inside[member] = True
    points = lumen.vertices_mm
    # Where a sac touches another artery the patch has a second, shorter edge.
    edges = triangles.boundary_loops(points, lumen.faces[inside[lumen.faces].all(axis=1)])
    return Bulge(points[member], points[edges[0] if edges else member], points[top], float(height_mm[top]))


def _patches(lumen: Surface, is_out: Bools) -> list[Ints]:
    """Vertices of every connected patch of three faces or more where `is_out` (n,) holds."""
    edges = triangles.directed_edges(lumen.faces)
    edges = edges[is_out[edges].all(axis=1)]
    label = triangles.joined(edges, len(is_out))
    count = np.bincount(label[is_out], minlength=label.max() + 1)
    return [np.flatnonzero(is_out & (label == k)) for k in np.flatnonzero(count >= 5)]


def _thickness_mm(lumen: Surface) -> Floats:
    """Depth (n,) of the lumen straight below every vertex (Shapira et al. 2008, Visual Computer 24:249, one ray)."""
    inward = -lumen.vertex_normals
    depth = lumen.first_hit(lumen.vertices_mm + 1e-3 * inward, inward)
    return np.where(np.isfinite(depth), depth, 0.0)
