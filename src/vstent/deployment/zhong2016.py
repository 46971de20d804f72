"""The paper's own method (Zhong et al. 2016): an active contour on evenly spaced rows, and nothing else."""

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
    """Eq. (1-7) of the paper to the letter.

    The device is as long as its label says, its rows evenly spaced, their first diameters those of the maximum
    inscribed spheres. It opens until 99 % of its nodes have met the wall, however wide the artery is: wires stretch,
    and no gap can show. `vstent.deployment.braid.ConstantWire` mends that.
    """

    def init(self, placement: Placement) -> Opened:
        """Put evenly spaced rows of inscribed circles over the label's length."""
        rows = grid(placement.design, placement.size).rows
        rows_mm = evenly_spaced_rows(placement.landing, placement.size.compacted_length_mm, rows)
        return Opened(placement.start(self.contour, rows_mm), rows_mm)

    def step(self, placement: Placement, opened: Opened) -> Opened:
        """One force step, one elastic step, and the three states of every node."""
        return replace(opened, contour=self.contour.step(opened.contour, placement.wall))

    def result(self, placement: Placement, opened: Opened) -> Opened:
        """Return the contour as the iterations left it."""
        return opened


def evenly_spaced_rows(landing: Landing, length_mm: float, rows: int) -> Floats:
    """Arc lengths (rows,) of rows of a device of a length, its landing point where it is to lie."""
    before_mm = {"proximal": 0.0, "center": 0.5 * length_mm, "distal": length_mm}[landing.anchor]
    return landing.abscissa_mm - before_mm + np.linspace(0.0, length_mm, rows)
