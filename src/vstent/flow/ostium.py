"""The ostium: the surface through which blood passes between the parent artery and the sac."""

from typing import Final

import numpy as np

from vstent.devices.stent import tube_faces
from vstent.errors import FlowError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Aneurysm
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats

ON_WALL_MM: Final = 1e-3
"""Distance to the lumen, mm, below which a face of a sac is wall: such faces are cut from the lumen."""
SHIFT_MM: Final = 0.5
"""Distance, mm, by which the neck plane is moved to show how much the neck inflow depends on its position."""
N_AROUND: Final = 96
"""Number of points around the section by a plane; its area is smaller by 0.07 % than that of a circle through them."""
N_RINGS: Final = 12
"""Number of rings of triangles in it."""


def ostium(aneurysm: Aneurysm, lumen: Surface) -> Surface:
    """Return the surface at which the neck inflow is counted, with normals into the sac.

    It is the part of the sac's closed surface that is not wall, around its neck: the section by the neck plane where
    that closes the sac, as at forks, and elsewhere the restored wall of the artery. Where the sac's flank was continued
    to that wall through the blood, blood also passes through the flank; only through both together do inflow and
    outflow balance.

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


def surfaces_beside(aneurysm: Aneurysm) -> dict[str, Surface]:
    """Return further surfaces through which an inflow is stated, by its name; empty for a sac without a neck plane.

    ``neck_inflow_in_sac`` is the section of the sac `SHIFT_MM` beyond the neck plane, ``neck_inflow_in_artery`` the
    outline of the neck moved as far into the artery, and ``plane_inflow`` the section by the neck plane itself.
    """
    plane = aneurysm.plane
    if plane is None:
        return {}
    shift_mm = SHIFT_MM * plane.normal
    below_mm = SHIFT_MM - (aneurysm.sac.vertices_mm - plane.center_mm) @ plane.normal
    vertices, faces, _ = triangles.clip(aneurysm.sac.vertices_mm, aneurysm.sac.faces, below_mm)
    rims_mm = [vertices[loop] for loop in triangles.boundary_loops(vertices, faces)]
    found = {
        "neck_inflow_in_artery": _flat(plane.rim_mm - shift_mm, plane.normal),
        "plane_inflow": _flat(plane.rim_mm, plane.normal),
    }
    if not rims_mm:  # a sac lower than the shift
        return found
    largest_mm = max(rims_mm, key=lambda rim_mm: abs(triangles.polygon_area_vector(rim_mm) @ plane.normal))
    return {"neck_inflow_in_sac": _flat(largest_mm, plane.normal)} | found


def sac_surfaces(anatomy: Anatomy) -> tuple[()] | tuple[Surface, Surface, dict[str, Surface]]:
    """Return the surfaces of the largest sac that `vstent.indices` takes: sac, ostium and `surfaces_beside`."""
    if not anatomy.aneurysms:
        return ()
    largest = anatomy.aneurysms[0]
    return largest.sac, ostium(largest, anatomy.vessel.lumen), surfaces_beside(largest)


def _flat(rim_mm: Floats, normal: Floats) -> Surface:
    """Return the plane surface inside a closed curve (k, 3), in rings around its centroid; normals along `normal`."""
    if triangles.polygon_area_vector(rim_mm) @ normal < 0:
        rim_mm = rim_mm[::-1]
    even_mm = curves.resample_evenly(np.concatenate([rim_mm, rim_mm[:1]]), N_AROUND + 1)[:-1]
    center_mm = triangles.polygon_centroid(even_mm)
    share = np.linspace(0.0, 1.0, N_RINGS + 1)[1:, None, None]
    rings_mm = center_mm + share * (even_mm - center_mm)
    fan = np.stack(
        [np.full(N_AROUND, N_RINGS * N_AROUND), np.arange(N_AROUND), np.roll(np.arange(N_AROUND), -1)], axis=1
    )
    faces = np.concatenate([fan, tube_faces(N_RINGS, N_AROUND)[:, ::-1]])
    return Surface(np.concatenate([rings_mm.reshape(-1, 3), center_mm[None]]), faces)
