"""Surface: a triangle mesh in mm, and the questions one asks of it."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from vstent.errors import VesselError
from vstent.kernels import medial, tree, triangles
from vstent.kernels.arrays import Bools, Floats, Ints, freeze

CREASE_RAD: Final = np.radians(35.0)
"""A mesh is not taken for a smooth surface where its vertices' normals lean so far from its faces'."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh; faces are counter-clockwise seen from outside."""

    vertices_mm: Floats
    """(n, 3) vertex positions."""
    faces: Ints
    """(m, 3) vertex indices."""

    def __post_init__(self) -> None:
        freeze(self, "vertices_mm", np.float64, (-1, 3))
        freeze(self, "faces", np.int32, (-1, 3))

    @cached_property
    def corners_mm(self) -> Floats:
        """(m, 3, 3) corner positions of every face."""
        return self.vertices_mm[self.faces]

    @cached_property
    def areas_mm2(self) -> Floats:
        """(m,) face areas."""
        return triangles.areas(self.corners_mm)

    @cached_property
    def normals(self) -> Floats:
        """(m, 3) unit face normals, outward; zero for a degenerate face."""
        return triangles.normals(self.corners_mm)

    @cached_property
    def vertex_normals(self) -> Floats:
        """(n, 3) unit vertex normals, angle weighted."""
        return triangles.vertex_normals(self.vertices_mm, self.faces)

    @cached_property
    def smooth_normals(self) -> Floats:
        """(m, 3, 3) unit normals, at every face's corners, of the smooth surface through the vertices.

        Where a corner's normal leans from its face's by more than `CREASE_RAD` the mesh is creased: all three are the
        face's own there.
        """
        normals = triangles.smooth_normals(self.vertices_mm, self.faces)[self.faces]
        least = np.einsum("fkd,fd->fk", normals, self.normals).min(axis=1)
        return np.where((least < np.cos(CREASE_RAD))[:, None, None], self.normals[:, None], normals)

    @cached_property
    def curved(self) -> tree.Curved:
        """Bounding-box tree over the smooth surface through the vertices."""
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
        """Bounding-box tree over the faces."""
        return tree.build(self.vertices_mm, self.faces)

    @cached_property
    def boundary_loops(self) -> tuple[Ints, ...]:
        """Vertex loops along the open edges, largest perimeter first; empty for a closed surface."""
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
        """What closes the boundary loops: the openings of a vessel's wall, facing outward."""
        return Surface(self.closed.vertices_mm, self.closed.faces[len(self.faces) :])

    @cached_property
    def medial(self) -> medial.Medial:
        """Centres and radii of the maximum inscribed spheres, and which are neighbours.

        Raises
        ------
        VesselError
            When none fits inside.
        """
        samples, normals = triangles.sample(self.vertices_mm, self.faces)
        found = medial.spheres(samples, normals, self.closed.tree, self.loop_centers_mm)
        if not len(found.points):
            raise VesselError(
                "the surface encloses no room for blood: it is flat, or a splinter; give the vessel's wall"
            )
        return found

    def closest(self, points_mm: Floats) -> tuple[Floats, Floats, Ints]:
        """Return the closest point (n, 3), its distance (n,) in mm and its face (n,) for (n, 3) points."""
        return tree.closest_points(self.tree, points_mm)

    def inscribed_radius(self, centers_mm: Floats) -> Floats:
        """Return the radius (n,) in mm of the largest sphere about each of (n, 3) points inside the smooth surface.

        A triangle is a chord: it lies inside a convex wall by the square of its edge, and a sphere that touches it is
        too small by as much. So the wall is curved over every face as its corners' normals tell.
        """
        return tree.inscribed_radii(self.curved, centers_mm)

    def signed_distance(self, points_mm: Floats) -> Floats:
        """Return the distance (n,) in mm of (n, 3) points, negative inside; the surface must be closed."""
        return tree.signed_distances(self.tree, points_mm)

    def crosses(self, starts_mm: Floats, ends_mm: Floats) -> Bools:
        """Tell for each segment start -> end, both (n, 3), whether it crosses the surface."""
        return tree.segments_cross(self.tree, starts_mm, ends_mm)

    def first_hit(self, origins_mm: Floats, directions: Floats) -> Floats:
        """Return the distance (n,) in mm along (n, 3) unit rays to the first face; inf where there is none."""
        return self.first_hits(origins_mm, directions)[0]

    def first_hits(self, origins_mm: Floats, directions: Floats) -> tuple[Floats, Ints]:
        """Return the distance (n,) in mm along (n, 3) unit rays to the first face (inf: none), and that face (n,)."""
        return tree.first_hits(self.tree, origins_mm, directions)
