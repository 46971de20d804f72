"""Tubes: the vessel as it would be around its centerlines alone, without any sac."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vstent.kernels.arrays import Floats, Ints, freeze
from vstent.trace import SPEED_CAP, parent_radius_mm
from vstent.vessel import Centerline


@dataclass(frozen=True, eq=False)
class Tubes:
    """A union of spheres along centerlines."""

    centers_mm: Floats
    """(n, 3) centerline points."""
    radius_mm: Floats
    """(n,) inscribed radius, no more than the parent artery's there."""

    def __post_init__(self) -> None:
        freeze(self, "centers_mm", np.float64, (-1, 3))
        freeze(self, "radius_mm", np.float64, (len(self.centers_mm),))

    def height_mm(self, points_mm: Floats) -> tuple[Floats, Ints]:
        """Return the distance (n,) of points (n, 3) to the tubes' wall, negative inside, and each one's sphere (n,)."""
        if not len(self.centers_mm):
            return np.full(len(points_mm), np.inf), np.zeros(len(points_mm), dtype=np.int32)
        # Sorting spheres by radius into a few classes makes the nearest wall a nearest-centre query per class.
        order = np.argsort(self.radius_mm)
        height, sphere = np.full(len(points_mm), np.inf), np.zeros(len(points_mm), dtype=np.int64)
        for members in np.array_split(order, min(16, len(order))):
            distance, nearest = cKDTree(self.centers_mm[members]).query(points_mm)
            candidate = distance - self.radius_mm[members][nearest]
            closer = candidate < height
            height, sphere = np.where(closer, candidate, height), np.where(closer, members[nearest], sphere)
        return height, sphere.astype(np.int32)


def tubes_of(centerlines: Sequence[Centerline]) -> Tubes:
    """Tubes around centerlines with the radius of the parent artery."""
    if not centerlines:
        return Tubes(np.zeros((0, 3)), np.zeros(0))
    radius = [
        np.minimum(line.inscribed_radius_mm, SPEED_CAP * parent_radius_mm(line.abscissa_mm, line.inscribed_radius_mm))
        for line in centerlines
    ]
    return Tubes(np.concatenate([line.points_mm for line in centerlines]), np.concatenate(radius))
