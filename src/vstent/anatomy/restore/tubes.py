"""Tubes around centerlines: the vessel as it would be without any sac."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from vstent.anatomy.trace import SPEED_CAP, parent_radius_mm
from vstent.geometry.vessel import Centerline
from vstent.kernels.arrays import Floats, Ints, freeze

N_CLASSES: Final = 16
"""Number of groups of spheres with similar radius."""


@dataclass(frozen=True, eq=False)
class Tubes:
    """Union of spheres along centerlines."""

    centers_mm: Floats
    """(n, 3) centerline points."""
    radius_mm: Floats
    """(n,) inscribed radius, limited by the radius of the parent artery there."""

    def __post_init__(self) -> None:
        freeze(self, "centers_mm", np.float64, (-1, 3))
        freeze(self, "radius_mm", np.float64, (len(self.centers_mm),))

    def height_mm(self, points_mm: Floats) -> tuple[Floats, Ints]:
        """Return the height (n,) of points (n, 3) above the tubes' wall, inf without any, and the sphere there (n,)."""
        if not len(self.centers_mm):
            return np.full(len(points_mm), np.inf), np.zeros(len(points_mm), dtype=np.int32)
        distance, nearest = cKDTree(self.centers_mm).query(points_mm)
        sphere = np.array(nearest, dtype=np.int32)
        own_mm = self.radius_mm[sphere]
        height = np.asarray(distance - own_mm)
        # Within a group of spheres of similar radius, the nearest wall is that of the sphere with the nearest center.
        # Across groups, only a sphere wider than the one at the nearest center can have a nearer wall.
        for members in np.array_split(np.argsort(-self.radius_mm), min(N_CLASSES, len(self.radius_mm))):
            widest = float(self.radius_mm[members[0]])
            open_ = np.flatnonzero(own_mm < widest)
            if not len(open_):
                continue
            limit = max(float(height[open_].max()) + widest, 0.0)
            query = cKDTree(self.centers_mm[members]).query(points_mm[open_], distance_upper_bound=limit)
            distance, nearest = np.asarray(query[0]), np.asarray(query[1])
            found = nearest < len(members)
            open_, chosen = open_[found], members[nearest[found]]
            candidate = distance[found] - self.radius_mm[chosen]
            closer = candidate < height[open_]
            height[open_[closer]], sphere[open_[closer]] = candidate[closer], chosen[closer]
        return height, sphere


def tubes_of(centerlines: Sequence[Centerline]) -> Tubes:
    """Return the tubes around centerlines, with the radius of the parent artery."""
    if not centerlines:
        return Tubes(np.zeros((0, 3)), np.zeros(0))
    radius = [
        np.minimum(line.inscribed_radius_mm, SPEED_CAP * parent_radius_mm(line.abscissa_mm, line.inscribed_radius_mm))
        for line in centerlines
    ]
    return Tubes(np.concatenate([line.points_mm for line in centerlines]), np.concatenate(radius))
