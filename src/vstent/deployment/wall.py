"""The wall of the artery as the contour uses it: the nearest wall point, and whether a segment crosses the wall."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, final

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from vstent.deployment.contour import normals
from vstent.devices.design import Braid
from vstent.devices.formulas import grid
from vstent.devices.stent import Stent, tube_faces
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.units import MM_PER_UM

RAMP_MM: Final = 0.6
"""Length, in mm, of the ramp from an end of a device to the wall around it, for a device that opens inside.

Wires do not follow a sharper step: with a shorter ramp those of the second device pass through the end of the first.
"""
SEAM_MM: Final = 0.4
"""Length, in mm, by which a ramp goes on along the wall, which ends in whole triangles at the foot of the ramp."""
ON_WALL_MM: Final = 1e-9
"""Distance, in mm, below which a point lies on the wall, so that the direction to its closest point is undefined."""
APPOSED_GAP_MM: Final = 0.1
"""Gap between the outer face of a device and the wall, in mm, below which a node is apposed."""
LOOSE_FRACTION: Final = 0.05
"""Fraction of a device, or of the body of a basket, that may have gaps without a note or another size proposed."""


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


def landing_wall(
    anatomy: Anatomy, inside: Sequence[Stent] = (), is_patient: Bools | None = None
) -> tuple[TreeWall, Bools]:
    """Build the wall against which a device opens, and say which triangles of it are the patient's own.

    It is the landing surface. Where devices are already deployed, it is the inner face of the last of them instead, and
    a ramp from its ends to the wall around them. `is_patient` (f,) says it for the landing surface, where not plain.
    """
    surface = anatomy.parent.landing_surface
    is_patient = anatomy.parent.is_patient_face if is_patient is None else is_patient
    for stent in inside:
        rings_mm = _ramped(inner_nodes_mm(stent), surface)
        place_mm = curves.project(anatomy.parent.axis.points_mm, surface.corners_mm.mean(axis=1))[0]
        reach_mm = RAMP_MM + SEAM_MM + 0.5 * stent.row_diameter_mm.max()
        is_open = (place_mm < stent.proximal_abscissa_mm - reach_mm) | (place_mm > stent.distal_abscissa_mm + reach_mm)
        for foot_mm, beyond_mm in ((rings_mm[1], rings_mm[0]), (rings_mm[-2], rings_mm[-1])):
            nearest = cKDTree(foot_mm).query(surface.vertices_mm)[1]
            off_mm, along_mm = surface.vertices_mm - foot_mm[nearest], (beyond_mm - foot_mm)[nearest]
            is_open |= (np.einsum("ij,ij->i", off_mm, along_mm) > 0)[surface.faces].all(axis=1)
        faces = tube_faces(*rings_mm.shape[:2]) + np.int32(len(surface.vertices_mm))
        vertices_mm = np.concatenate([surface.vertices_mm, rings_mm.reshape(-1, 3)])
        surface = Surface(vertices_mm, np.concatenate([surface.faces[is_open], faces]))
        is_patient = np.concatenate([is_patient[is_open], np.zeros(len(faces), dtype=bool)])
    return TreeWall(surface), is_patient


def _ramped(nodes_mm: Floats, wall: Surface) -> Floats:
    """Return the inner face (rows, columns, 3) of a device, with a ramp and a seam on the wall at each end."""
    rings_mm = [nodes_mm]
    for end, before in ((0, 1), (-1, -2)):
        along = nodes_mm[end] - nodes_mm[before]
        along = along / curves.lengths(along)[:, None]
        added_mm = [wall.closest(nodes_mm[end] + by_mm * along)[0][None] for by_mm in (RAMP_MM, RAMP_MM + SEAM_MM)]
        rings_mm = [*added_mm[::-1], *rings_mm] if end == 0 else [*rings_mm, *added_mm]
    return np.concatenate(rings_mm)


def inner_nodes_mm(stent: Stent) -> Floats:
    """Return the inner face (rows, columns, 3) of a device on the nodes of its contour.

    The contour runs through the middle of a braid, one wire from its inner face, and along the inner face of struts,
    whose free crowns may point further inward.
    """
    outward = normals(stent.nodes_mm)
    if isinstance(stent.design, Braid):
        return stent.nodes_mm - stent.design.mesh_offset_um * MM_PER_UM * outward
    depth_mm = np.zeros(stent.nodes_mm.shape[:2])
    if stent.crown_shift_mm.size:
        shape = grid(stent.design, stent.size)
        of_crowns = np.s_[:: shape.row_split, :: shape.column_split]
        inward_mm = -np.einsum("krcd,rcd->krc", stent.crown_shift_mm, outward[of_crowns])
        depth_mm[of_crowns] = np.maximum(inward_mm.max(axis=0), 0.0)
        around = 2 * shape.row_split + 1, 2 * shape.column_split + 1
        depth_mm = maximum_filter(depth_mm, around, mode=("nearest", "wrap"))
    return np.asarray(stent.nodes_mm - depth_mm[..., None] * outward)
