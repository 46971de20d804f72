"""Describe the shape of a sac beyond its neck plane: undulation, ellipticity and nonsphericity index."""

from typing import Final, NamedTuple

import numpy as np

from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Aneurysm
from vstent.kernels import triangles
from vstent.kernels.arrays import Floats

ON_NECK_MM: Final = 1e-4
"""Distance from the neck, in mm, below which a face of the sac belongs to it: both have the same triangles."""
ON_PLANE_MM: Final = 1e-6
"""A neck within this distance of a plane, in mm, lies in it: the whole sac is beyond."""
ON_PLANE: Final = 1e-6
"""Largest deviation from 1 of the cosine between the neck plane's normal and that of a facet on the plane."""
HALF_SPHERE: Final = float(np.cbrt(18 * np.pi))
"""Wall area of a half sphere over its volume to the power 2/3."""


class Beyond(NamedTuple):
    """The part of a sac beyond its neck plane."""

    section_mm2: float
    """Area of the largest piece of the section by the plane, in mm2."""
    volume_mm3: float
    """Volume, in mm3."""
    wall_mm2: float
    """Area of the wall without the section and without the neck, in mm2."""
    points_mm: Floats
    """(n, 3) points of the wall, those on the plane included, in mm."""


def beyond_plane(aneurysm: Aneurysm, center_mm: Floats, normal: Floats) -> Beyond:
    """Cut a sac by a plane and measure the part beyond.

    Shapes: `center_mm` (3,), `normal` (3,).
    """
    sac = aneurysm.sac
    if np.abs((aneurysm.neck.corners_mm - center_mm) @ normal).max() < ON_PLANE_MM:
        neck_mm2 = aneurysm.neck.area_mm2
        return Beyond(neck_mm2, sac.volume_mm3, sac.area_mm2 - neck_mm2, sac.vertices_mm)
    below_mm = -(sac.vertices_mm - center_mm) @ normal
    vertices, faces, _ = triangles.clip(sac.vertices_mm, sac.faces, below_mm)
    loops = triangles.boundary_loops(vertices, faces)
    capped, closed = triangles.cap(vertices, faces, loops)
    sections = [float(np.linalg.norm(triangles.polygon_area_vector(vertices[loop]))) for loop in loops]
    is_wall = aneurysm.neck.closest(vertices[faces].mean(axis=1))[1] > ON_NECK_MM
    wall_mm2 = Surface(vertices, faces[is_wall]).area_mm2
    points_mm = vertices[np.unique(faces)]
    return Beyond(max(sections, default=0.0), triangles.volume(capped[closed]), wall_mm2, points_mm)


def shape_indices(beyond: Beyond, normal: Floats) -> dict[str, float]:
    """Compute the shape indices of Raghavan, Ma and Harbaugh 2005.

    With volume V and wall area S of the sac beyond the neck plane, and those of its convex hull, V_h and S_h:

    - undulation index 1 - V / V_h,
    - ellipticity index 1 - (18 pi)^(1/3) V_h^(2/3) / S_h,
    - nonsphericity index 1 - (18 pi)^(1/3) V^(2/3) / S.

    The areas are without the neck plane. All three are 0 for a half sphere. Empty if no wall lies beyond the plane.

    Parameters
    ----------
    beyond : the sac beyond its neck plane.
    normal : (3,) unit normal of the plane, toward the dome.

    References
    ----------
    Raghavan, Ma and Harbaugh 2005, J. Neurosurg. 102:355.
    """
    from scipy.spatial import ConvexHull

    if beyond.wall_mm2 == 0:
        return {}
    hull = ConvexHull(beyond.points_mm)
    corners = beyond.points_mm[hull.simplices]
    is_dome = hull.equations[:, :3] @ normal > ON_PLANE - 1
    hull_mm2 = 0.5 * float(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[is_dome], axis=1).sum()
    )
    return {
        "undulation_index": 1 - beyond.volume_mm3 / float(hull.volume),
        "ellipticity_index": 1 - HALF_SPHERE * float(hull.volume) ** (2 / 3) / hull_mm2,
        "nonsphericity_index": 1 - HALF_SPHERE * beyond.volume_mm3 ** (2 / 3) / beyond.wall_mm2,
    }
