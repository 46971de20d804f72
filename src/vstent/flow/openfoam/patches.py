"""The blood's boundary as named patches, watertight together."""

from dataclasses import dataclass

import numpy as np

from vstent.flow.case import FlowCase
from vstent.flow.domain import extend
from vstent.geometry.surface import Surface
from vstent.kernels.arrays import Floats, Ints, freeze

ON_SAC_MM = 1e-3
"""Faces of the wall nearer to the sac's surface than this are the sac's."""


@dataclass(frozen=True, eq=False)
class Patch:
    """A named part of a closed surface."""

    name: str
    """``wall``, ``sac``, or the role of an opening: ``inlet``, ``outlet_1``, ..."""
    surface: Surface
    """The whole boundary; shared by all patches."""
    face_id: Ints
    """(f,) faces of it that are this patch."""

    def __post_init__(self) -> None:
        freeze(self, "face_id", np.int32, (-1,))

    @property
    def corners_mm(self) -> Floats:
        """(f, 3, 3) corners of its faces."""
        return self.surface.corners_mm[self.face_id]

    @property
    def area_mm2(self) -> float:
        """Its area."""
        return float(self.surface.areas_mm2[self.face_id].sum())


def named_patches(case: FlowCase) -> tuple[tuple[Patch, ...], tuple[Floats, ...]]:
    """Cut the boundary of the blood into patches: ``wall``, ``sac`` where there is one, ``inlet``, ``outlet_1``, ...

    Every opening stands at the end of the straight extension that all engines give it (see `domain.extend`).

    Returns
    -------
    patches : all of one closed surface, every face in one patch.
    sections : for every opening the polygon (k, 3) of its end, mm.

    Raises
    ------
    FlowError
        When an opening has no open end of the lumen.
    """
    surface, face_patch, sections = extend(case.vessel)
    wall = np.flatnonzero(face_patch == 0)
    is_sac = np.zeros(len(wall), dtype=bool)
    if case.sac is not None:
        is_sac = case.sac.closest(surface.corners_mm[wall].mean(axis=1))[1] < ON_SAC_MM
    faces = {"wall": wall[~is_sac], "sac": wall[is_sac]}
    faces |= {one.role: np.flatnonzero(face_patch == k + 1) for k, one in enumerate(case.vessel.openings)}
    return tuple(Patch(name, surface, ids) for name, ids in faces.items() if len(ids)), sections


def stl_text(solids: dict[str, Floats], scale: float) -> str:
    """Return named solids, each the corners (f, 3, 3) of its faces, as one ASCII STL; lengths times `scale`."""
    return "".join(_solid(name, corners * scale) for name, corners in solids.items())


def _solid(name: str, corners: Floats) -> str:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    rows = np.concatenate([normal, corners.reshape(-1, 9)], axis=1)
    face = (
        "facet normal %.6g %.6g %.6g\nouter loop\nvertex %.9g %.9g %.9g\nvertex %.9g %.9g %.9g\n"
        "vertex %.9g %.9g %.9g\nendloop\nendfacet\n"
    )
    return f"solid {name}\n" + "".join(face % tuple(row) for row in rows) + f"endsolid {name}\n"
