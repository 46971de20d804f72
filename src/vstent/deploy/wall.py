"""Wall: what the contour asks of the artery: where is the nearest wall, and is it between two points."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Final, NamedTuple, final

import numpy as np

from vstent.kernels.arrays import Bools, Floats
from vstent.surface import Surface

ON_WALL_MM: Final = 1e-9
"""A point this near to the wall lies on it: the direction to its closest point says nothing."""


class Contact(NamedTuple):
    """The nearest wall for every one of n points."""

    closest_mm: Floats
    """(n, 3) closest points of the wall."""
    distance_mm: Floats
    """(n,) distances to them, never negative."""
    normal: Floats
    """(n, 3) unit wall normals there, out of the lumen."""

    def inward(self, points_mm: Floats) -> Floats:
        """Return unit directions (n, 3) from the wall to points; the wall's own normal, reversed, for points on it."""
        away = points_mm - self.closest_mm
        length = np.linalg.norm(away, axis=1)
        is_on_wall = length < ON_WALL_MM
        away = away / np.where(is_on_wall, 1.0, length)[:, None]
        away[is_on_wall] = -self.normal[is_on_wall]
        return away


class AbstractWall(ABC):
    """An artery's wall. Final classes differ in how they search, never in what they answer."""

    @abstractmethod
    def contact(self, points_mm: Floats) -> Contact:
        """Return the nearest wall of (n, 3) points."""

    @abstractmethod
    def crosses(self, starts_mm: Floats, ends_mm: Floats) -> Bools:
        """Tell for each of n segments, (n, 3) starts to (n, 3) ends, whether it crosses the wall."""


@final
@dataclass(frozen=True, eq=False)
class TreeWall(AbstractWall):
    """The exact wall, searched through a tree of axis-aligned bounding boxes."""

    surface: Surface
    """The landing surface, normals out of the lumen."""

    def contact(self, points_mm: Floats) -> Contact:
        """Return the nearest wall of (n, 3) points."""
        closest_mm, distance_mm, face = self.surface.closest(points_mm)
        return Contact(closest_mm, distance_mm, self.surface.normals[face])

    def crosses(self, starts_mm: Floats, ends_mm: Floats) -> Bools:
        """Tell for each of n segments, (n, 3) starts to (n, 3) ends, whether it crosses the wall."""
        return self.surface.crosses(starts_mm, ends_mm)
