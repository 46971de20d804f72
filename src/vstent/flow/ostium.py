"""The ostium: the surface through which blood passes between the parent artery and the sac."""

import numpy as np

from vstent.errors import FlowError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Aneurysm
from vstent.kernels import triangles

ON_WALL_MM = 1e-3
"""Distance to the lumen, mm, below which a face of a sac is wall: such faces are cut from the lumen."""


def ostium(aneurysm: Aneurysm, lumen: Surface) -> Surface:
    """Return the part of the sac's closed surface that is not wall, around its neck and with normals into the sac.

    The neck is the part of it on the landing surface. Where the sac's flank was continued to that surface through the
    blood, blood also passes through the flank; only through both together do inflow and outflow balance.

    Raises
    ------
    FlowError
        The sac has no opening.
    """
    sac = aneurysm.sac
    is_open = lumen.closest(sac.corners_mm.mean(axis=1))[1] > ON_WALL_MM
    if not is_open.any():
        raise FlowError(
            "the sac has no opening to the artery, so no blood can enter it: restore the parent artery again"
        )
    middle_mm = aneurysm.neck.vertices_mm[np.argmax(lumen.closest(aneurysm.neck.vertices_mm)[1])]
    vertices, faces = triangles.part_at(sac.vertices_mm, sac.faces[is_open], middle_mm)
    return Surface(vertices, faces[:, ::-1])
