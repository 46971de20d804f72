"""Cells on which contrast is carried: those of the flow in and beside the sac, blocks of them elsewhere."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from vstent.angiography.network import Network, network
from vstent.errors import FlowError
from vstent.flow import sampling
from vstent.flow.case import FlowCase, FlowField
from vstent.geometry.surface import Surface
from vstent.kernels.arrays import Floats, Ints

FINE_MM: Final = 0.4
"""Distance from the sac, mm, within which the cells of the flow are kept; elsewhere blocks of eight are used."""
REGION_MM: Final = 3.0
"""Distance from the sac, mm, within which its washout is followed; blood that gets farther does not come back."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Cells and flow rates, and which cells lie in the sac."""

    network: Network
    """Cells and flow rates."""
    sac: Ints
    """(s,) cells in the sac; all cells where there is none."""
    distance_mm: Floats
    """(n,) distance of the cells from those of the sac, inf beyond 3 mm; 0 where there is none."""

    @cached_property
    def near(self) -> tuple[Network, Ints]:
        """The network of the sac and its surroundings, and its cells (s,) in the sac."""
        region = self.distance_mm <= REGION_MM
        return self.network.within(region), (np.cumsum(region) - 1)[self.sac]


def grid_of(case: FlowCase, field: FlowField, *, is_preview: bool) -> Grid:
    """Return the cells on which contrast is carried through a flow; those of a preview are twice as wide."""
    whole = network(case, field)
    if is_preview:
        whole = whole.merged(np.ones(len(whole.cells), dtype=bool))
    if case.sac is None:
        return Grid(whole, np.arange(len(whole.cells)), np.zeros(len(whole.cells)))
    # Wider blocks upstream would spread the bolus: blocks of four cells beyond 3 mm change the retention by 2 %.
    return _from_sac(whole.merged(_from_sac(whole, case.sac).distance_mm > FINE_MM), case.sac)


def _from_sac(whole: Network, sac: Surface) -> Grid:
    """Return a grid whose network has fine cells in a sac."""
    points_mm, fine = whole.points_mm, int(whole.width.min())
    is_fine = whole.width == fine
    at_mm = whole.spacing_mm * (whole.cells[is_fine] + 0.5 * (fine - 1))  # the grid's own centers, in its own frame
    shift_mm = np.median(points_mm[is_fine] - at_mm, axis=0)
    inside = sampling.cells_inside(sac, at_mm + shift_mm, fine * whole.spacing_mm)
    if len(inside) == 0:
        raise FlowError("no cell of the flow lies in the sac: compute the flow with a finer grid spacing")
    cells = np.flatnonzero(is_fine)[inside]
    distance_mm = np.full(len(points_mm), np.inf)
    low, high = points_mm[cells].min(axis=0), points_mm[cells].max(axis=0)
    near = np.flatnonzero(((points_mm > low - REGION_MM) & (points_mm < high + REGION_MM)).all(axis=1))
    distance_mm[near] = cKDTree(points_mm[cells]).query(points_mm[near], distance_upper_bound=REGION_MM)[0]
    return Grid(whole, cells, distance_mm)
