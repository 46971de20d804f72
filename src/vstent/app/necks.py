"""Necks drawn on the page: a closed curve with handles that are dragged along the wall."""

from typing import Any, Final

import numpy as np

from vstent.app.choices import NECK_HANDLES
from vstent.geometry.vessel import Anatomy
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats

POINTS: Final = 96
"""Number of points of a neck on the page."""
REACH: Final = 1.5
"""Distance from a dragged handle within which the curve moves too, in handle spacings."""


def curve_of(anatomy: Anatomy) -> Floats:
    """Return the neck of the first sac as evenly spaced points (n, 3); empty without a sac."""
    if not anatomy.aneurysms:
        return np.zeros((0, 3))
    ring = anatomy.aneurysms[0].neck_mm
    return curves.resample_evenly(np.concatenate([ring, ring[:1]]), POINTS + 1)[:-1]


def pulled(anatomy: Anatomy, curve_mm: Floats, handle: int, to_mm: Floats) -> Floats:
    """Return a neck with one handle moved to a point of the wall; the points near it move too.

    Moved points are projected on the wall in proportion to their movement. All other points stay exactly unchanged.
    """
    at = round(handle * len(curve_mm) / NECK_HANDLES)
    away = (np.arange(len(curve_mm)) - at + len(curve_mm) / 2) % len(curve_mm) - len(curve_mm) / 2
    share = np.clip(np.abs(away) * NECK_HANDLES / len(curve_mm) / REACH, 0.0, 1.0)
    weight = 0.5 * (1.0 + np.cos(np.pi * share))[:, None]
    moved = curve_mm + weight * (to_mm - curve_mm[at])
    return moved + weight * (anatomy.vessel.lumen.closest(moved)[0] - moved)


def told(curve_mm: Floats) -> dict[str, Any]:
    """Return points, area and perimeter of a neck, with the definitions of `vstent.morphology`."""
    return {
        "curve_mm": np.round(curve_mm, 3).tolist(),
        "area_mm2": float(np.linalg.norm(triangles.polygon_area_vector(curve_mm))) if len(curve_mm) else 0.0,
        "perimeter_mm": float(triangles.perimeter(curve_mm)) if len(curve_mm) else 0.0,
        "handles": NECK_HANDLES,
    }
