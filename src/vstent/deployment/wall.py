"""The wall of the artery as the contour uses it: the nearest wall point, and whether a segment crosses the wall."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, final

import numpy as np

from vstent.deployment.contour import normals
from vstent.devices.stent import Stent
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.units import MM_PER_UM

OVERLAP_MM: Final = 0.5
"""Length, in mm, by which the artery's wall is kept inside each end of a device that is already in it."""
ON_WALL_MM: Final = 1e-9
"""Distance, in mm, below which a point lies on the wall, so that the direction to its closest point is undefined."""


class Contact(NamedTuple):
    """Nearest wall of n points."""

    closest_mm: Floats
    """(n, 3) closest points of the wall, in mm."""
    distance_mm: Floats
    """(n,) distances to them, in mm, never negative."""
    normal: Floats
    """(n, 3) unit normals of the wall there, out of the lumen."""
    face: Ints
    """(n,) triangles of the wall there."""

    def replaced(self, where: Bools, new: "Contact") -> "Contact":
        """Return a contact in which the points selected by `where` (n,) have the values of `new`."""
        copies = Contact(self.closest_mm.copy(), self.distance_mm.copy(), self.normal.copy(), self.face.copy())
        for values, others in zip(copies, new, strict=True):
            values[where] = others
        return copies

    def inward(self, points_mm: Floats) -> Floats:
        """Return unit directions (n, 3) from the wall to points (n, 3); for points on the wall, the reversed normal."""
        away = points_mm - self.closest_mm
        length = curves.lengths(away)
        is_on_wall = length < ON_WALL_MM
        away = away / np.where(is_on_wall, 1.0, length)[:, None]
        away[is_on_wall] = -self.normal[is_on_wall]
        return away


class AbstractWall(ABC):
    """Interface of an artery's wall. Implementations differ in how they search, not in their results."""

    @abstractmethod
    def contact(self, points_mm: Floats) -> Contact:
        """Return the wall point nearest to each of the points (n, 3) in mm, with its distance and face."""

    @abstractmethod
    def crosses(self, starts_mm: Floats, ends_mm: Floats) -> Bools:
        """Return whether each segment from `starts_mm` (n, 3) to `ends_mm` (n, 3) crosses the wall, (n,)."""


@final
@dataclass(frozen=True, eq=False)
class TreeWall(AbstractWall):
    """Exact wall, searched by a tree of axis-aligned bounding boxes."""

    surface: Surface
    """Landing surface, with normals out of the lumen."""

    def contact(self, points_mm: Floats) -> Contact:
        """Return the wall point nearest to each of the points (n, 3) in mm, with its distance and face."""
        closest_mm, distance_mm, face = self.surface.closest(points_mm)
        return Contact(closest_mm, distance_mm, self.surface.normals[face], face)

    def crosses(self, starts_mm: Floats, ends_mm: Floats) -> Bools:
        """Return whether each segment from `starts_mm` (n, 3) to `ends_mm` (n, 3) crosses the wall, (n,)."""
        return self.surface.crosses(starts_mm, ends_mm)


def landing_wall(anatomy: Anatomy, inside: Sequence[Stent] = ()) -> tuple[AbstractWall, Bools]:
    """Build the wall against which a device opens.

    It is the landing surface. Where devices are already deployed, it is the inner face of the last of them instead.
    """
    surface = anatomy.parent.landing_surface
    is_patient = anatomy.parent.is_patient_face
    for stent in inside:
        foot_mm = curves.project(anatomy.parent.axis.points_mm, surface.corners_mm.mean(axis=1))[0]
        first_mm, last_mm = stent.proximal_abscissa_mm + OVERLAP_MM, stent.distal_abscissa_mm - OVERLAP_MM
        is_open = (foot_mm < first_mm) | (foot_mm > last_mm)
        inner, faces = inner_face(stent), surface.faces[is_open]
        beyond = np.int32(len(surface.vertices_mm))
        vertices_mm = np.concatenate([surface.vertices_mm, inner.vertices_mm])
        surface = Surface(vertices_mm, np.concatenate([faces, inner.faces + beyond]))
        is_patient = np.concatenate([is_patient[is_open], np.zeros(len(inner.faces), dtype=bool)])
    return TreeWall(surface), is_patient


def inner_face(stent: Stent) -> Surface:
    """Return the inner face of a device: its contour moved inward by the thickness of its mesh."""
    nodes_mm = stent.nodes_mm - stent.design.mesh_offset_um * MM_PER_UM * normals(stent.nodes_mm)
    return Surface(nodes_mm.reshape(-1, 3), stent.contour.faces)
