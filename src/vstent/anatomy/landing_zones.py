"""The neck on the parent axis, and the landing zones beside it."""

from typing import Final

import numpy as np

from vstent.geometry.vessel import Anatomy
from vstent.kernels import triangles
from vstent.kernels.arrays import Floats

ZONE_MM: Final = 5.0
"""Length of a landing zone beside the neck."""


def neck_span_mm(anatomy: Anatomy) -> tuple[float, float]:
    """Where the neck of the largest aneurysm begins and ends on the parent axis; the axis's middle without one."""
    if anatomy.aneurysms:
        return anatomy.aneurysms[0].proximal_abscissa_mm, anatomy.aneurysms[0].distal_abscissa_mm
    middle_mm = 0.5 * anatomy.axis.length_mm
    return middle_mm, middle_mm


def neck_points_mm(anatomy: Anatomy) -> Floats:
    """Corners (n, 3) of the faces of the largest aneurysm's neck; none without one."""
    if not anatomy.aneurysms:
        return np.zeros((0, 3))
    neck = anatomy.aneurysms[0].neck
    return triangles.compact(neck.vertices_mm, neck.faces)[0]


def landing_diameters_mm(anatomy: Anatomy) -> tuple[float, float]:
    """Mean diameter of the parent artery in the proximal and in the distal landing zone."""
    proximal_mm, distal_mm = neck_span_mm(anatomy)
    length_mm = anatomy.axis.length_mm
    before = np.linspace(max(0.0, proximal_mm - ZONE_MM), max(0.0, proximal_mm), 51)
    after = np.linspace(min(length_mm, distal_mm), min(length_mm, distal_mm + ZONE_MM), 51)
    diameter_mm = 2 * anatomy.section_radius_mm
    first, second = (np.interp(zone, anatomy.axis.abscissa_mm, diameter_mm).mean() for zone in (before, after))
    return float(first), float(second)
