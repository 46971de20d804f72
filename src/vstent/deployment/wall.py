"""Wall: what the contour asks of the artery: where is the nearest wall, and is it between two points."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, final

import numpy as np

from vstent import plugins
from vstent.deployment.contour import normals
from vstent.devices.stent import Stent
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.units import MM_PER_UM

TREE: Final = "tree"
"""Name of the wall that is searched through a tree."""
OVERLAP_MM: Final = 0.5
"""The artery's wall is kept this far behind the ends of a device that lies in it."""
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
    face: Ints
    """(n,) the wall's triangle there."""

    def replaced(self, where: Bools, new: "Contact") -> "Contact":
        """Return the contact with that of the points chosen (n,) replaced by `new`."""
        copies = Contact(self.closest_mm.copy(), self.distance_mm.copy(), self.normal.copy(), self.face.copy())
        for values, others in zip(copies, new, strict=True):
            values[where] = others
        return copies

    def inward(self, points_mm: Floats) -> Floats:
        """Return unit directions (n, 3) from the wall to points; the wall's own normal, reversed, for points on it."""
        away = points_mm - self.closest_mm
        length = curves.lengths(away)
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
        return Contact(closest_mm, distance_mm, self.surface.normals[face], face)

    def crosses(self, starts_mm: Floats, ends_mm: Floats) -> Bools:
        """Tell for each of n segments, (n, 3) starts to (n, 3) ends, whether it crosses the wall."""
        return self.surface.crosses(starts_mm, ends_mm)


def landing_wall(anatomy: Anatomy, inside: Sequence[Stent] = (), search: str = TREE) -> tuple[AbstractWall, Bools]:
    """Return what a device opens against, and which of its faces (m,) are the patient's own wall.

    That is the landing surface or, where devices already lie in it, their inner faces, the last one foremost.

    Raises
    ------
    PluginError
        When no plug-in is called `search`.
    """
    kind = TreeWall if search == TREE else plugins.load("vstent.walls", search, built_in=TREE)
    surface = anatomy.landing_surface
    is_patient = ~anatomy.is_restored_face
    for stent in inside:
        foot_mm = curves.project(anatomy.axis.points_mm, surface.corners_mm.mean(axis=1))[0]
        first_mm, last_mm = stent.proximal_abscissa_mm + OVERLAP_MM, stent.distal_abscissa_mm - OVERLAP_MM
        is_open = (foot_mm < first_mm) | (foot_mm > last_mm)
        surface = _joined(Surface(surface.vertices_mm, surface.faces[is_open]), inner_face(stent))
        n_inner = len(surface.faces) - int(is_open.sum())
        is_patient = np.concatenate([is_patient[is_open], np.zeros(n_inner, dtype=bool)])
    return kind(surface), is_patient


def inner_face(stent: Stent) -> Surface:
    """Return a device's inner face: its contour, nearer to the axis by the wire that fits between it and the wall."""
    nodes_mm = stent.nodes_mm - stent.design.wall_offset_um * MM_PER_UM * normals(stent.nodes_mm)
    return Surface(nodes_mm.reshape(-1, 3), stent.contour.faces)


def _joined(first: Surface, second: Surface) -> Surface:
    vertices_mm = np.concatenate([first.vertices_mm, second.vertices_mm])
    return Surface(vertices_mm, np.concatenate([first.faces, second.faces + np.int32(len(first.vertices_mm))]))
