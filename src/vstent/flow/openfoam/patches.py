"""The boundary of the blood as named patches that together form a closed surface."""

from dataclasses import dataclass

import numpy as np

from vstent.flow.case import FlowCase
from vstent.flow.domain import extend
from vstent.geometry.surface import Surface
from vstent.kernels import triangles
from vstent.kernels.arrays import Floats, Ints, freeze

ON_SAC_MM = 1e-3
"""Distance to the sac's surface, mm, below which a face of the wall belongs to the sac."""


@dataclass(frozen=True, eq=False)
class Patch:
    """A named part of a closed surface."""

    name: str
    """``wall``, ``sac``, or the role of an opening: ``inlet``, ``outlet_1``, ..."""
    surface: Surface
    """The whole boundary, shared by all patches."""
    face_id: Ints
    """(f,) indices of this patch's faces in the boundary."""

    def __post_init__(self) -> None:
        freeze(self, "face_id", np.int32, (-1,))

    @property
    def corners_mm(self) -> Floats:
        """Corners (f, 3, 3) of the faces."""
        return self.surface.corners_mm[self.face_id]

    @property
    def area_mm2(self) -> float:
        """Area of the patch."""
        return float(self.surface.areas_mm2[self.face_id].sum())


def named_patches(case: FlowCase) -> tuple[tuple[Patch, ...], tuple[Floats, ...]]:
    """Divide the boundary of the blood into patches: ``wall``, ``sac`` if there is one, ``inlet``, ``outlet_1``, ...

    Every opening is at the end of the straight extension that all engines use (see `domain.extend`). The second value
    is the polygon (k, 3) in mm of every such end.
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
    """Return named solids, corners (f, 3, 3) times a scale, as the text of one ASCII STL file."""
    face = (
        "facet normal %.6g %.6g %.6g\nouter loop\nvertex %.9g %.9g %.9g\nvertex %.9g %.9g %.9g\n"
        "vertex %.9g %.9g %.9g\nendloop\nendfacet\n"
    )
    text = ""
    for name, corners in solids.items():
        scaled = corners * scale
        rows = np.concatenate([triangles.normals(scaled), scaled.reshape(-1, 9)], axis=1)
        text += f"solid {name}\n" + "".join(face % tuple(row) for row in rows) + f"endsolid {name}\n"
    return text
