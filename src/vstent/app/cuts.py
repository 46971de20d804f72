"""Speed of the flow on the plane of the profile view."""

from typing import Final

import numpy as np

from vstent.flow.case import FlowField
from vstent.flow.sampling import is_blood, values_at
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy
from vstent.reporting.scene import MeshLayer, views_of

STEP_CELLS: Final = 0.6
"""Distance between the points of a cut, as a fraction of the finest grid spacing."""


def cut(pane: str, field: FlowField, anatomy: Anatomy, toward_mm: float = 0.0) -> MeshLayer:
    """Return the speed on a plane of the profile view, so far from the center of the sac, or else of the axis."""
    right, up, toward = views_of(anatomy)[0].axes
    sacs = anatomy.aneurysms
    middle = sacs[0].sac.vertices_mm.mean(axis=0) if sacs else anatomy.parent.axis.points_mm.mean(axis=0)
    middle = middle + toward_mm * toward
    step_mm = STEP_CELLS * field.finest.cell_size_mm
    seen = (field.centers_mm - middle) @ np.stack([right, up], axis=1)
    ticks = [np.arange(low, high + step_mm, step_mm) for low, high in zip(seen.min(0), seen.max(0), strict=True)]
    columns, rows = np.meshgrid(*ticks, indexing="ij")
    points_mm = middle + columns[..., None] * right + rows[..., None] * up
    speed = np.linalg.norm(values_at(field, points_mm.reshape(-1, 3))[0], axis=1)
    # Triangles of the grid with all corners in blood.
    n, m = points_mm.shape[:2]
    number, points_mm = np.arange(n * m).reshape(n, m), points_mm.reshape(-1, 3)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    quads = quads[is_blood(field, points_mm)[quads].all(axis=1)]
    used, corners = np.unique(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), return_inverse=True)
    surface = Surface(points_mm[used], corners.reshape(-1, 3))
    return MeshLayer("slice", pane, (0.5, 0.5, 0.5), surface, scale="slice_speed", values=speed[used])
