"""The ostium: what blood crosses on its way between the parent artery and the sac."""

import numpy as np

from vstent.errors import FlowError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Aneurysm
from vstent.kernels import triangles

ON_WALL_MM = 1e-3
"""Faces of a sac nearer to the lumen's wall than this are wall: they were cut from it."""


def ostium(aneurysm: Aneurysm, lumen: Surface) -> Surface:
    """Return the part of the sac's closed surface around its neck that is no wall, its normals into the sac.

    The neck is that part as far as it lies on the landing surface. Where the sac's flank was continued down to it
    through the blood, blood crosses the flank as well: only through both together does as much leave as enters.

    Raises
    ------
    FlowError
        When the sac has no opening.
    """
    sac = aneurysm.sac
    is_open = lumen.closest(sac.corners_mm.mean(axis=1))[1] > ON_WALL_MM
    if not is_open.any():
        raise FlowError("the sac is closed all around, so no blood enters it: restore the vessel again")
    middle_mm = aneurysm.neck.vertices_mm[np.argmax(lumen.closest(aneurysm.neck.vertices_mm)[1])]
    vertices, faces = triangles.part_at(sac.vertices_mm, sac.faces[is_open], middle_mm)
    return Surface(vertices, faces[:, ::-1])
