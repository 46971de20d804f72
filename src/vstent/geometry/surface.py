"""A triangle mesh in mm, with geometric queries."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from vstent.errors import VesselError
from vstent.kernels import medial, tree, triangles
from vstent.kernels.arrays import Bools, Floats, Ints, freeze

CREASE_RAD: Final = np.radians(35.0)
"""A mesh is creased where vertex and face normals differ by more than this angle, in rad."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh with counter-clockwise faces seen from outside."""

    vertices_mm: Floats
    """(n, 3) positions of the vertices."""
    faces: Ints
    """(m, 3) vertex indices of the faces."""

    def __post_init__(self) -> None:
        freeze(self, "vertices_mm", np.float64, (-1, 3))
        freeze(self, "faces", np.int32, (-1, 3))

    @cached_property
    def corners_mm(self) -> Floats:
        """(m, 3, 3) corner positions of every face."""
        return self.vertices_mm[self.faces]

    @cached_property
    def areas_mm2(self) -> Floats:
        """(m,) areas of the faces."""
        return triangles.areas(self.corners_mm)

    @cached_property
    def normals(self) -> Floats:
        """(m, 3) outward unit normals of the faces; zero for a degenerate face."""
        return triangles.normals(self.corners_mm)

    @cached_property
    def vertex_normals(self) -> Floats:
        """(n, 3) unit normals at the vertices, weighted by angle."""
        return triangles.vertex_normals(self.vertices_mm, self.faces)

    @cached_property
    def smooth_normals(self) -> Floats:
        """(m, 3, 3) unit normals of the smooth surface through the vertices, at the corners of every face.

        Where one of a face's corner normals differs from the face normal by more than `CREASE_RAD`, the mesh is
        creased. The face normal is then used at all three corners.
        """
        normals = triangles.smooth_normals(self.vertices_mm, self.faces)[self.faces]
        least = np.einsum("fkd,fd->fk", normals, self.normals).min(axis=1)
        return np.where((least < np.cos(CREASE_RAD))[:, None, None], self.normals[:, None], normals)

    @cached_property
    def curved(self) -> tree.Tree:
        """Bounding-box tree of the smooth surface through the vertices."""
        return tree.curved(self.tree, self.smooth_normals)

    @property
    def area_mm2(self) -> float:
        """Total area."""
        return float(self.areas_mm2.sum())

    @property
    def volume_mm3(self) -> float:
        """Enclosed volume of a closed surface (divergence theorem)."""
        return triangles.volume(self.corners_mm)

    @cached_property
    def tree(self) -> tree.Tree:
        """Bounding-box tree of the faces."""
        return tree.build(self.vertices_mm, self.faces)

    @cached_property
    def boundary_loops(self) -> tuple[Ints, ...]:
        """Loops of vertices along the open edges, longest first; empty for a closed surface."""
        return triangles.boundary_loops(self.vertices_mm, self.faces)

    @cached_property
    def loop_centers_mm(self) -> Floats:
        """(k, 3) centroids of the boundary loops."""
        centers = [triangles.polygon_centroid(self.vertices_mm[loop]) for loop in self.boundary_loops]
        return np.array(centers, dtype=np.float64).reshape(-1, 3)

    @cached_property
    def closed(self) -> "Surface":
        """The surface with every boundary loop capped."""
        return Surface(*triangles.cap(self.vertices_mm, self.faces, self.boundary_loops))

    @cached_property
    def caps(self) -> "Surface":
        """The caps of the boundary loops, facing outward: the openings of a vessel's wall."""
        return Surface(self.closed.vertices_mm, self.closed.faces[len(self.faces) :])

    @cached_property
    def medial(self) -> medial.Medial:
        """Centers, radii and adjacency of the maximum inscribed spheres; a VesselError where no sphere fits inside."""
        samples, normals = triangles.sample(self.vertices_mm, self.faces)
        spheres = medial.spheres(samples, normals, self.closed.tree, self.loop_centers_mm)
        if not len(spheres.points):
            raise VesselError(
                "the surface encloses no room for blood: it is flat, or a splinter; give the vessel's wall"
            )
        return spheres

    def closest(self, points_mm: Floats) -> tuple[Floats, Floats, Ints]:
        """Return the closest points (n, 3) of the surface and their distances (n,), both in mm, and faces (n,)."""
        return tree.closest_points(self.tree, points_mm)

    def inscribed_radius(self, centers_mm: Floats) -> Floats:
        """Return the radius (n,), in mm, of the largest sphere around each point (n, 3) inside the smooth surface.

        A triangle is a chord of the wall. On a convex wall it lies inside by an amount that grows with the square of
        its edge length, so a sphere that touches it is too small. The wall is therefore curved over every face
        according to the normals at its corners.
        """
        return tree.inscribed_radii(self.curved, centers_mm)

    def signed_distance(self, points_mm: Floats) -> Floats:
        """Return the distance (n,) in mm from points (n, 3) to the closed surface, negative inside."""
        return tree.signed_distances(self.tree, points_mm)

    def crosses(self, starts_mm: Floats, ends_mm: Floats) -> Bools:
        """Return whether each segment between points (n, 3) in mm crosses the surface."""
        return tree.segments_cross(self.tree, starts_mm, ends_mm)

    def first_hit(self, origins_mm: Floats, directions: Floats) -> Floats:
        """Return the distance (n,) in mm along unit rays (n, 3) to the first face; inf where there is none."""
        return self.first_hits(origins_mm, directions)[0]

    def first_hits(self, origins_mm: Floats, directions: Floats) -> tuple[Floats, Ints]:
        """Return the distance (n,) in mm along unit rays (n, 3) to the first face, inf without one, and that face."""
        return tree.first_hits(self.tree, origins_mm, directions)


def joined(surfaces: Sequence[Surface]) -> Surface:
    """Return several surfaces as one; they share no vertex."""
    before = np.cumsum([0, *(len(surface.vertices_mm) for surface in surfaces)])
    faces = [surface.faces + first for surface, first in zip(surfaces, before[:-1], strict=True)]
    return Surface(np.concatenate([surface.vertices_mm for surface in surfaces]), np.concatenate(faces))
