"""The porous screen of a stent on the lattice: its resistance in the grid cells near it, in lattice units."""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from vstent.flow.case import FlowCase, Sheet
from vstent.flow.domain import Domain
from vstent.flow.drag import concentration
from vstent.flow.lattice.kernels import d3q19, sheet
from vstent.flow.lattice.scales import Scales
from vstent.flow.lattice.setup import Addressing
from vstent.kernels.arrays import Floats, Ints
from vstent.units import M_PER_MM


@dataclass(frozen=True, eq=False)
class ScreenEntries:
    """Resistance of a screen by segment of cells, in lattice units (see `d3q19.update`)."""

    start: Ints
    """(s + 1,) first entry of every segment."""
    place: Ints
    """(e,) position of the entry's cell within its segment."""
    entry: NDArray[np.float32]
    """(e, `d3q19.ENTRY`) unit normal and resistance coefficients."""
    cell: Ints
    """(e,) cell number of every entry."""

    def stretched(self, stretch: float) -> "ScreenEntries":
        """Return the same screen for time steps `stretch` times as long.

        Coefficients that multiply a velocity grow with the time step.
        """
        return replace(self, entry=self.entry * np.array([1, 1, 1, stretch, stretch, 1, stretch], np.float32))


@dataclass(frozen=True, eq=False)
class GridResistance:
    """Resistance of a screen distributed over the grid cells near it."""

    cell: Ints
    """(e,) cell numbers, ascending."""
    normal: Floats
    """(e, 3) unit normal of the screen in the cell."""
    along_Pa_s_m2: Floats
    """(e,) resistance per volume along the normal: pressure gradient divided by velocity."""
    across_Pa_s_m2: Floats
    """(e,) resistance per volume tangential to the screen."""
    spread_Pa_s_m: Floats
    """(e,) part of the tangential resistance that acts twice because the screen is spread over layers of cells (see
    `collision.of_thin_sheet`)."""
    inertial_per_m: Floats
    """(e,) inertial loss: pressure gradient along the normal divided by rho |u| u_n."""


def build_screen(case: FlowCase, domain: Domain, addressing: Addressing, scales: Scales) -> ScreenEntries:
    """Return the screen of a case in lattice units.

    Parameters
    ----------
    case : FlowCase
        The flow case; without media the result is empty.
    domain : Domain
        The grid.
    addressing : Addressing
        Segments of cells.
    scales : Scales
        Lattice units.
    """
    segments = len(addressing.length)
    if not case.media:
        return ScreenEntries(*d3q19.no_screen(segments), np.zeros(0, np.int32))
    spread = on_grid(case.media, domain.index, domain.origin_mm, domain.cell_size_mm)
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


def on_grid(media: tuple[Sheet, ...], index: Ints, origin_mm: Floats, cell_size_mm: float) -> GridResistance:
    """Distribute the resistance of media over grid cells.

    Every sample point is shared among the eight cells around it with trilinear weights. The share of
    points outside the blood is dropped. A cell at the rim therefore resists as its neighbours do where the screen
    extends over the wall beyond the neck.

    Parameters
    ----------
    media : tuple of Sheet
        Sample points with normals, areas and resistances.
    index : (i, j, k) int
        Cell number at every grid point, -1 outside.
    origin_mm : (3,)
        Position of grid point 0, 0, 0.
    cell_size_mm : float
        Grid spacing.
    """
    screen = Sheet(*(np.concatenate([getattr(one, part.name) for one in media]) for part in fields(Sheet)))
    factor, volume = _concentration(screen, cell_size_mm), cell_size_mm**3 * M_PER_MM
    along_Pa_s_m, across_Pa_s_m = screen.normal_resistance_Pa_s_m, screen.tangential_resistance_Pa_s_m
    values = screen.area_mm2 / volume, factor * along_Pa_s_m, factor * across_Pa_s_m, screen.inertial_loss
    cells = int(index.max(initial=-1)) + 1
    number, found, sums = np.full(cells, -1, np.int32), np.zeros(cells, np.int32), np.zeros((cells, sheet.COLUMNS))
    frame = np.array([*origin_mm, cell_size_mm])
    rows = sheet.spread(index, frame, (screen.points_mm, screen.normals, *values), number, found, sums)
    order = np.argsort(found[:rows])
    order = order[sums[order, 3] > 0]
    found, sums = found[order], sums[order]
    # Normals of one sheet nearly agree. Where two sheets meet their signs may differ, but only n n^T enters.
    normal, along, across, squared, loss = np.split(sums, [3, 4, 5, 6], axis=1)
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return GridResistance(
        found,
        normal / length,
        along[:, 0],
        across[:, 0],
        (squared / np.maximum(across, 1e-300))[:, 0],
        0.5 * loss[:, 0],
    )


def _concentration(screen: Sheet, cell_size_mm: float) -> Floats:
    """Return the factor on the drag of every sample (see `concentration`); neighbours on one wire share theirs."""
    diameter_mm, spacing_mm = screen.wire_diameter_mm, screen.spacing_mm
    is_new = np.ones(len(diameter_mm), dtype=bool)
    is_new[1:] = (diameter_mm[1:] != diameter_mm[:-1]) | (spacing_mm[1:] != spacing_mm[:-1])
    factor = concentration(diameter_mm[is_new], spacing_mm[is_new], cell_size_mm)
    return np.repeat(factor, np.diff(np.flatnonzero(np.r_[is_new, True])))
