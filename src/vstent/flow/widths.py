"""Widths of the neck and of the parent artery, by which grids are judged and chosen."""

import numpy as np

from vstent.flow.case import FlowCase
from vstent.flow.domain import mean_diameter_mm
from vstent.flow.indices import NEAR_MM
from vstent.geometry.surface import Surface


def neck_diameter_mm(ostium: Surface) -> float:
    """Return the diameter of a circle with the area of the ostium."""
    return float(np.sqrt(4 * ostium.area_mm2 / np.pi))


def parent_diameter_mm(case: FlowCase) -> float:
    """Return the diameter of the artery beside the neck: of the widest path, a low quartile because a sac widens it."""
    ostium = case.ostium
    assert ostium is not None
    near = [line.inscribed_radius_mm[ostium.closest(line.points_mm)[1] < NEAR_MM] for line in case.vessel.centerlines]
    widths_mm = [2 * float(np.quantile(radius_mm, 0.25)) for radius_mm in near if len(radius_mm)]
    return max(widths_mm, default=mean_diameter_mm(case.vessel))
