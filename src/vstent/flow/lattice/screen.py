"""A stent's screen on the lattice: shared among the grid cells beside it, in the lattice's own units."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vstent.flow.case import FlowCase, Screen
from vstent.flow.domain import Domain
from vstent.flow.drag import concentration
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.scales import Scales
from vstent.flow.lattice.setup import Addressing
from vstent.kernels import sampling
from vstent.kernels.arrays import Floats, Ints
from vstent.units import M_PER_MM


@dataclass(frozen=True, eq=False)
class ScreenEntries:
    """A screen by segment (see `d3q19.update`)."""

    start: Ints
    """(s + 1,)."""
    place: Ints
    """(e,) place within the segment."""
    entry: NDArray[np.float32]
    """(e, `d3q19.ENTRY`)."""
    cell: Ints
    """(e,) cell."""

    def stretched(self, stretch: float) -> "ScreenEntries":
        """The same for time steps that are so many times as long: all that goes with a speed is so much more."""
        return replace(self, entry=self.entry * np.array([1, 1, 1, stretch, stretch, 1, stretch], np.float32))


@dataclass(frozen=True, eq=False)
class GridResistance:
    """A screen spread over the grid cells beside it."""

    cell: Ints
    """(e,) cells, ascending."""
    normal: Floats
    """(e, 3) the screen's unit normal there."""
    along_Pa_s_m2: Floats
    """(e,) resistance along the normal per volume: pressure gradient per velocity."""
    across_Pa_s_m2: Floats
    """(e,) resistance across it."""
    spread_Pa_s_m: Floats
    """(e,) what of the screen's resistance across it acts twice, in layers of cells (see `of_thin_sheet`)."""
    inertial_per_m: Floats
    """(e,) pressure gradient along the normal over rho |u| u_n."""


def build_screen(case: FlowCase, domain: Domain, addressing: Addressing, scales: Scales) -> ScreenEntries:
    """The case's screen in lattice units."""
    segments = len(addressing.length)
    if case.screen is None:
        return ScreenEntries(*d3q19.no_screen(segments), np.zeros(0, np.int32))
    spread = on_grid(case.screen, domain.index, domain.origin_mm, domain.cell_size_mm)
    per_step = scales.step_s / case.blood.density_kg_m3
    entry = np.column_stack(
        [
            spread.normal,
            spread.along_Pa_s_m2 * per_step,
            spread.across_Pa_s_m2 * per_step,
            spread.inertial_per_m * scales.cell_m,
            spread.spread_Pa_s_m / (case.blood.density_kg_m3 * scales.speed_m_s),
        ]
    )
    segment = np.searchsorted(addressing.first_cell, spread.cell, side="right") - 1
    start = np.searchsorted(segment, np.arange(segments + 1)).astype(np.int32)
    place = (spread.cell - addressing.first_cell[segment]).astype(np.int32)
    return ScreenEntries(start, place, entry.astype(np.float32), spread.cell)


def on_grid(screen: Screen, index: Ints, origin_mm: Floats, cell_size_mm: float) -> GridResistance:
    """Share every sample's resistance among the eight cells around it, trilinearly; what falls outside is void.

    So a cell at the rim resists as its neighbours do, where the screen goes on over the wall beyond the neck.

    Parameters
    ----------
    index : (i, j, k) cell number at every grid point, -1 outside.
    """
    at = (screen.points_mm - origin_mm) / cell_size_mm
    cells, weights = sampling.stencils(index, at)
    share = np.where(cells >= 0, weights, 0.0)
    is_used = share > 0
    cell, owner = cells[is_used], np.broadcast_to(np.arange(len(cells))[:, None], cells.shape)[is_used]
    per_volume = share[is_used] * screen.area_mm2[owner] / (cell_size_mm**3 * M_PER_MM)
    found, place = np.unique(cell, return_inverse=True)

    def gathered(values: Floats) -> Floats:
        return np.bincount(place, per_volume * values[owner], len(found)).astype(np.float64)

    # The normals of one sheet agree nearly; signs may differ where two sheets meet in a cell, but only n n^T counts.
    normal = np.stack([gathered(component) for component in screen.normals.T], axis=1)
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    factor = concentration(screen.wire_diameter_mm, screen.spacing_mm, cell_size_mm)
    along = gathered(factor * screen.normal_resistance_Pa_s_m)
    across_Pa_s_m = factor * screen.tangential_resistance_Pa_s_m
    across, twice = gathered(across_Pa_s_m), _twice(at, screen.normals)
    kept = along > 0
    return GridResistance(
        found[kept].astype(np.int32),
        (normal / length)[kept],
        along[kept],
        across[kept],
        (gathered(twice * across_Pa_s_m**2) / np.maximum(across, 1e-300))[kept],
        0.5 * gathered(screen.inertial_loss)[kept],
    )


def _twice(at: Floats, normals: Floats) -> Floats:
    """Sum (p,) over pairs of cells about points (p, 3) of their trilinear weights and their way along the normals."""
    part = at - np.floor(at)
    corners = np.indices((2, 2, 2)).reshape(3, -1).T
    weight = np.where(corners == 1, part[:, None], 1 - part[:, None]).prod(axis=2)
    height = normals @ corners.T
    return np.asarray(
        sum(weight[:, a] * weight[:, b] * np.abs(height[:, a] - height[:, b]) for a in range(8) for b in range(a))
    )
