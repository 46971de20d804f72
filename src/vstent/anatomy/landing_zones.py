"""Position of the neck on the parent axis, and the landing zones on both sides of it."""

from typing import Final

import numpy as np

from vstent.geometry.vessel import Anatomy
from vstent.kernels import triangles
from vstent.kernels.arrays import Floats

ZONE_MM: Final = 5.0
"""Length of a landing zone beside the neck, in mm."""


def neck_span_mm(anatomy: Anatomy) -> tuple[float, float]:
    """Return where the largest aneurysm's neck begins and ends on the parent axis; the middle of it without one."""
    if anatomy.aneurysms:
        return anatomy.parent.span_mm(anatomy.aneurysms[0])
    middle_mm = 0.5 * anatomy.parent.axis.length_mm
    return middle_mm, middle_mm


def beside_neck(anatomy: Anatomy, abscissa_mm: float) -> str:
    """Say where a place on the parent axis is, from the nearer end of the neck; from the inlet without a neck."""
    if not anatomy.aneurysms:
        return f"{abscissa_mm:.1f} mm from the inlet"
    proximal_mm, distal_mm = neck_span_mm(anatomy)
    if abscissa_mm < proximal_mm:
        return f"{proximal_mm - abscissa_mm:.1f} mm proximal to the neck"
    if abscissa_mm > distal_mm:
        return f"{abscissa_mm - distal_mm:.1f} mm distal to the neck"
    if abscissa_mm - proximal_mm < distal_mm - abscissa_mm:
        return f"{abscissa_mm - proximal_mm:.1f} mm distal to the proximal end of the neck"
    return f"{distal_mm - abscissa_mm:.1f} mm proximal to the distal end of the neck"


def neck_points_mm(anatomy: Anatomy) -> Floats:
    """Return the vertices (n, 3) of the largest aneurysm's neck in mm; empty without an aneurysm."""
    if not anatomy.aneurysms:
        return np.zeros((0, 3))
    neck = anatomy.aneurysms[0].neck
    return triangles.compact(neck.vertices_mm, neck.faces)[0]


def zone_diameters_mm(anatomy: Anatomy) -> tuple[Floats, Floats]:
    """Return diameters (51,) of the parent artery along the landing zones before and after the neck, in mm."""
    proximal_mm, distal_mm = neck_span_mm(anatomy)
    first_mm, last_mm = anatomy.parent.own_mm
    before = np.linspace(max(first_mm, proximal_mm - ZONE_MM), max(first_mm, proximal_mm), 51)
    after = np.linspace(min(last_mm, distal_mm), min(last_mm, distal_mm + ZONE_MM), 51)
    along_mm, diameter_mm = anatomy.parent.axis.abscissa_mm, 2 * anatomy.parent.section_radius_mm
    return np.interp(before, along_mm, diameter_mm), np.interp(after, along_mm, diameter_mm)


def landing_diameters_mm(anatomy: Anatomy) -> tuple[float, float]:
    """Return the mean diameters of the parent artery in the landing zones before and after the neck, in mm."""
    before_mm, after_mm = zone_diameters_mm(anatomy)
    return float(before_mm.mean()), float(after_mm.mean())
