"""The method of Zhong et al. 2016: an active contour on evenly spaced rows, without the mechanics of wires."""

from dataclasses import dataclass, replace
from typing import final

import numpy as np

from vstent.deployment.method import AbstractMethod, Opened, Placement
from vstent.devices.formulas import grid
from vstent.devices.stent import Landing
from vstent.kernels.arrays import Floats


@final
@dataclass(frozen=True, eq=False)
class Zhong2016(AbstractMethod):
    """Deployment method that follows eq. (1-7) of Zhong et al. 2016 without changes.

    The device is as long as its label states, with evenly spaced rows that start as circles of the maximum inscribed
    spheres. It opens until 99 % of its nodes have met the wall, however wide the artery is. The wires can therefore
    stretch, and the result cannot show gaps to the wall. `vstent.deployment.braid.ConstantWire` avoids both.
    """

    def init(self, placement: Placement) -> Opened:
        """Return evenly spaced rows of inscribed circles over the label length."""
        rows = grid(placement.design, placement.size).rows
        rows_mm = evenly_spaced_rows(placement.landing, placement.size.compacted_length_mm, rows)
        return Opened(placement.start(self.contour, rows_mm), rows_mm)

    def step(self, placement: Placement, opened: Opened) -> Opened:
        """Return the device after one iteration of the active contour."""
        return replace(opened, contour=self.contour.step(opened.contour, placement.wall))

    def result(self, placement: Placement, opened: Opened) -> Opened:
        """Return the contour as the last iteration left it."""
        return opened


def evenly_spaced_rows(landing: Landing, length_mm: float, rows: int) -> Floats:
    """Compute evenly spaced arc lengths for the rows of a device."""
    before_mm = {"proximal": 0.0, "center": 0.5 * length_mm, "distal": length_mm}[landing.anchor]
    return landing.abscissa_mm - before_mm + np.linspace(0.0, length_mm, rows)
