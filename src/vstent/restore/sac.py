"""The sac: the lumen outside the landing surface that holds a bulge's dome, and the neck that closes it."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats, Ints
from vstent.restore.bulges import FLANK, Bulge, bulge_at
from vstent.restore.landing import Landing
from vstent.restore.tubes import Tubes, tubes_of
from vstent.surface import Surface
from vstent.vessel import Aneurysm, Centerline, Vessel

DEPARTURE: Final = 0.05
"""The neck is where the wall has left the landing surface by this many parent radii: a tenth of a millimetre."""
FLANK_LENGTH: Final = 0.8
"""From the bulge down to the neck the sac's flank is at most this many parent radii long."""
ON_ARTERY_MM: Final = 0.5
"""A rim that comes nearer than this to the landing surface is a neck on the parent artery."""
BRANCH_SHARE: Final = 0.15
"""A branch's own wall stands out of its tube by less than this many radii."""
FLAT: Final = 0.2
"""Less volume than this fraction of neck area to the power 3/2 is an uneven wall (a half sphere has 0.38)."""
N_RINGS: Final = 12
"""Rings of the neck's triangles."""


def cut_sac(vessel: Vessel, landing: Landing, side_lines: Sequence[Centerline], bulge: Bulge) -> Aneurysm | None:
    """Cut the sac of a bulge off the lumen; None where it does not hang on the parent artery, or is flat.

    Side branches that leave from the sac or beside it are cut off along their own tubes.
    """
    lumen = vessel.lumen
    level = _height_mm(lumen.vertices_mm, landing, _branch_tubes(side_lines, landing, bulge))
    parent = landing.section_radius_mm[landing.nearest_sections(lumen.vertices_mm)]
    core = bulge_at(lumen, level, level > FLANK * parent, bulge.dome_mm)
    if core is None:
        return None
    level = np.minimum(level - DEPARTURE * parent, FLANK_LENGTH * parent - core.distances_mm(lumen.vertices_mm))
    vertices, faces, _ = triangles.clip(lumen.vertices_mm, lumen.faces, -level)
    vertices, faces = triangles.part_at(vertices, faces, bulge.dome_mm)
    loops = triangles.boundary_loops(vertices, faces)
    rims = [loop for loop in loops if landing.surface.closest(vertices[loop])[1].min() < ON_ARTERY_MM]
    if not rims:
        return None
    rim = rims[0]
    neck = _neck(landing, vertices[rim])
    sac = _closed_sac(vertices, faces, [loop for loop in loops if loop is not rim], rim, neck)
    if sac.volume_mm3 < FLAT * neck.area_mm2**1.5:
        return None
    abscissa = curves.project(landing.points_mm, vertices[rim])[0]
    return Aneurysm(sac, neck, vertices[rim], float(abscissa.min()), float(abscissa.max()))


def _height_mm(points_mm: Floats, landing: Landing, branches: Tubes) -> Floats:
    """How far points (n, 3) of the wall stand out of the landing surface and of the side branches' own walls."""
    height, sphere = branches.height_mm(points_mm)
    radius = branches.radius_mm[sphere] if len(branches.radius_mm) else np.ones(len(points_mm))
    return np.minimum(landing.solid.signed_distance(points_mm), height - BRANCH_SHARE * radius)


def _branch_tubes(lines: Sequence[Centerline], landing: Landing, bulge: Bulge) -> Tubes:
    """Tubes of the side branches beyond the parent artery, and beyond the sac where they leave from it."""
    proper = []
    for line in lines:
        in_artery = landing.solid.signed_distance(line.points_mm) < -0.5 * line.inscribed_radius_mm
        in_sac = bulge.distances_mm(line.points_mm) < 1.2 * line.inscribed_radius_mm
        inner = np.flatnonzero(in_artery | in_sac)
        first = inner[-1] + 1 if len(inner) else 0
        if len(line.points_mm) - first > 1:
            proper.append(Centerline(line.points_mm[first:], line.inscribed_radius_mm[first:]))
    return tubes_of(proper)


def _neck(landing: Landing, rim_mm: Floats) -> Surface:
    """The landing surface inside a closed curve (k, 3) on it: rings from the curve to its middle.

    The outermost ring is the curve itself, so that the sac closes without a gap. The curve runs with the sac's wall,
    so the faces along it look into the sac.
    """
    grid = landing.grid_of(rim_mm)
    grid[:, 1] = np.unwrap(grid[:, 1], period=landing.n_rays)
    middle = grid.mean(axis=0)
    lift = rim_mm - landing.at_grid(grid)
    share = np.linspace(1.0, 0.0, N_RINGS + 1)[:-1]
    rings = [landing.at_grid(middle + f * (grid - middle)) + f * lift for f in share]
    vertices = np.concatenate([*rings, landing.at_grid(middle[None])])
    k = len(rim_mm)
    here, there = np.arange(k), (np.arange(k) + 1) % k
    faces = [np.stack([np.full(k, N_RINGS * k), (N_RINGS - 1) * k + here, (N_RINGS - 1) * k + there], axis=1)]
    for ring in range(N_RINGS - 1):
        a, b = ring * k, (ring + 1) * k
        faces.append(np.stack([a + here, a + there, b + here], axis=1))
        faces.append(np.stack([a + there, b + there, b + here], axis=1))
    return Surface(vertices, np.concatenate(faces))


def _closed_sac(vertices: Floats, faces: Ints, other_loops: list[Ints], rim: Ints, neck: Surface) -> Surface:
    """The sac's wall, its branches' mouths and its neck as one closed surface."""
    points, wall = triangles.cap(vertices, faces, other_loops)
    # The neck's first ring is the rim: those vertices are shared, the others appended.
    number = np.concatenate([rim, len(points) + np.arange(len(neck.vertices_mm) - len(rim))])
    closed = np.concatenate([wall, number[neck.faces[:, ::-1]]])
    return Surface(np.concatenate([points, neck.vertices_mm[len(rim) :]]), closed)
