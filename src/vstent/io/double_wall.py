"""Detect hollow models: surfaces that contain the inner and the outer wall of an artery."""

from typing import Final

import numpy as np

from vstent.geometry.surface import Surface
from vstent.kernels import topology, triangles
from vstent.kernels.arrays import Floats, Ints

SHARP_COSINE: Final = 0.5
"""Cosine of the angle between the normals of neighboring faces below which an edge is sharp, as at the rims that join
an inner and an outer wall."""
LEAST_AREA: Final = 0.3
"""Smallest ratio of the areas of an inner and an outer wall."""
LEAST_COVERED: Final = 0.9
"""Smallest fraction of the inner wall's vertices in the bounding box of the outer wall, widened by the thickness."""
MOST_UNEVEN: Final = 4.0
"""Largest ratio of the thickest to the thinnest part of a wall, without the thinnest and thickest 5 %."""
THICKEST: Final = 0.35
"""Largest thickness of a wall, as a fraction of the hydraulic diameter 4 V / A of the inner wall."""
SAMPLES: Final = 2000
"""Approximate number of vertices at which the thickness is measured."""


def inner_wall(surface: Surface) -> Surface | None:
    """Return the inner wall of a hollow model, in its own unit; None where a surface is not one.

    The faces are divided at sharp edges. A hollow model has two large parts, one inside the other at a nearly constant
    distance; the inner one has the smaller area.
    """
    kept, same = topology.first_equals(surface.vertices_mm)
    welded = same[surface.faces].astype(np.int32)
    sound = topology.sound_faces(welded)
    points_mm, faces = surface.vertices_mm[kept], welded[sound]
    part = _smooth_parts(points_mm, faces)
    area = np.bincount(part, triangles.areas(points_mm[faces]))
    if len(area) < 2:
        return None
    outer, inner = np.argsort(area)[::-1][:2]
    if area[inner] < LEAST_AREA * area[outer]:
        return None
    walls = [Surface(*triangles.compact(points_mm, faces[part == one])) for one in (inner, outer)]
    return walls[0] if _is_around(*walls) else None


def _smooth_parts(points_mm: Floats, faces: Ints) -> Ints:
    """Return the number (m,) of the part that every face belongs to; sharp and open edges separate parts."""
    normal, pairs = triangles.normals(points_mm[faces]), topology.face_neighbours(faces)
    # The two walls may have equal or opposite orientation, so the sign of the normals is ignored.
    is_smooth = np.abs(np.einsum("ij,ij->i", normal[pairs[:, 0]], normal[pairs[:, 1]])) > SHARP_COSINE
    return triangles.joined(pairs[is_smooth], len(faces))


def _is_around(inner: Surface, outer: Surface) -> bool:
    """Return whether the outer wall surrounds the inner one at a nearly constant distance."""
    sample = inner.vertices_mm[:: max(1, len(inner.vertices_mm) // SAMPLES)]
    thickness = outer.closest(sample)[1]
    thin, thick = np.quantile(thickness, [0.05, 0.95])
    vertices, closed = triangles.cap(
        inner.vertices_mm, inner.faces, triangles.boundary_loops(inner.vertices_mm, inner.faces)
    )
    diameter = 4 * abs(triangles.volume(vertices[closed])) / max(inner.area_mm2, 1e-300)
    is_even = 0 < thin and thick < MOST_UNEVEN * thin and thick < THICKEST * diameter
    low, high = outer.vertices_mm.min(axis=0), outer.vertices_mm.max(axis=0)
    is_within = ((sample > low - thick) & (sample < high + thick)).all(axis=1).mean()
    return bool(is_even and is_within >= LEAST_COVERED)
