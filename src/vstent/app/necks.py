"""Necks drawn on the page: a closed curve with handles, of which one is pulled along the wall."""

from typing import Any, Final

import numpy as np

from vstent.app.choices import NECK_HANDLES
from vstent.geometry.vessel import Anatomy
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats
from vstent.reporting.scene import LineLayer, curves_layer

POINTS: Final = 96
"""Points of a neck on the page."""
REACH: Final = 1.5
"""A handle takes the curve along on both sides as far as this many handles away."""
_DRAWN: Final = (0.72, 0.20, 0.16)


def curve_of(anatomy: Anatomy) -> Floats:
    """Return the neck found, as evenly spaced points (n, 3); none where there is no sac."""
    if not anatomy.aneurysms:
        return np.zeros((0, 3))
    ring = anatomy.aneurysms[0].neck_mm
    return curves.resample_evenly(np.concatenate([ring, ring[:1]]), POINTS + 1)[:-1]


def pulled(anatomy: Anatomy, curve_mm: Floats, handle: int, to_mm: Floats) -> Floats:
    """Return a neck (n, 3) of which one handle was pulled to a point (3,) of the wall; its neighbours come along.

    What is moved is drawn onto the wall as far as it is moved; the rest stays as it is, to the bit.
    """
    at = round(handle * len(curve_mm) / NECK_HANDLES)
    away = (np.arange(len(curve_mm)) - at + len(curve_mm) / 2) % len(curve_mm) - len(curve_mm) / 2
    share = np.clip(np.abs(away) * NECK_HANDLES / len(curve_mm) / REACH, 0.0, 1.0)
    weight = 0.5 * (1.0 + np.cos(np.pi * share))[:, None]
    moved = curve_mm + weight * (to_mm - curve_mm[at])
    return moved + weight * (anatomy.vessel.lumen.closest(moved)[0] - moved)


def layer_of(curve_mm: Floats) -> LineLayer:
    """Return a neck as a layer for the scene, in the place of the one that was found."""
    return curves_layer("neck", [np.concatenate([curve_mm, curve_mm[:1]])], 0.08, _DRAWN)


def told(curve_mm: Floats) -> dict[str, Any]:
    """Return a neck's points and its size, as `vstent.measure` defines it."""
    return {
        "curve_mm": np.round(curve_mm, 3).tolist(),
        "area_mm2": float(np.linalg.norm(triangles.polygon_area_vector(curve_mm))) if len(curve_mm) else 0.0,
        "perimeter_mm": float(triangles.perimeter(curve_mm)) if len(curve_mm) else 0.0,
        "handles": NECK_HANDLES,
    }
