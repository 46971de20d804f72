"""The screen of a case on the lattice: the resistance of its media in the grid cells near them, in lattice units.

Sheets that share a cell add as tensors: sheet k resists the velocity u of the cell with a_k (u.n_k) n_k along its
normal and with b_k (u - (u.n_k) n_k) across it, and its inertial loss is added. A cell stores one axis with a
resistance along and across it. The axis is that of the normals: the one that they share, or the line along which two
sheets meet if they cross at more than 70 degrees. The resistances are those of the summed tensor along this axis, and
its mean across it. This is exact for parallel sheets and for equal ones that meet at a right angle. In between, blood
that passes two planes crossing every 16 cells is up to 9 instead of 6 % too fast: six coefficients would gain little.

`GridResistance.spread_Pa_s_m` is the mean of the sheets, weighted by their tangential resistance. The velocity along
two sheets within a cell of each other is within 15 % behind them for 60 Pa s/m each, and -40 to +60 % off for 380. From
two cells apart on each acts as alone (`tests/flow/test_screen_sheet.py`).

A region, in which coils resist alike in all directions, has the normal 0. Where it shares a cell with a sheet, its
inertial loss is right along the sheet's normal and half as large across it, because a cell stores one coefficient.

Two like meshes resist twice as much as one, also where they touch (`benchmarks/meshes.py`): their sum is used.
"""

from collections.abc import Sequence
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
    """(e, 3) unit normal of the sheet in the cell; of several sheets the axis of their resistance."""
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
    """Return the screen of a case in lattice units."""
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


def on_grid(media: Sequence[Sheet], index: Ints, origin_mm: Floats, cell_size_mm: float) -> GridResistance:
    """Distribute the resistance of media over the grid cells numbered by `index` (i, j, k)."""
    alone = [_of_sheet(one, index, origin_mm, cell_size_mm) for one in media]
    return alone[0] if len(alone) == 1 else _combined(alone)


def _of_sheet(one: Sheet, index: Ints, origin_mm: Floats, cell_size_mm: float) -> GridResistance:
    """Distribute the resistance of a sheet over grid cells (see `on_grid`).

    Every sample point is shared among the eight cells around it with trilinear weights. The share of points outside the
    blood is dropped. A cell at the rim therefore resists as its neighbours do where the sheet extends over the wall
    beyond the neck.
    """
    diameter_mm, spacing_mm = one.wire_diameter_mm, one.spacing_mm
    is_new = np.ones(len(diameter_mm), dtype=bool)  # neighbours on one wire share their concentration
    is_new[1:] = (diameter_mm[1:] != diameter_mm[:-1]) | (spacing_mm[1:] != spacing_mm[:-1])
    factor = concentration(diameter_mm[is_new], spacing_mm[is_new], cell_size_mm)[np.cumsum(is_new) - 1]
    volume = cell_size_mm**3 * M_PER_MM
    along_Pa_s_m, across_Pa_s_m = one.normal_resistance_Pa_s_m, one.tangential_resistance_Pa_s_m
    values = one.area_mm2 / volume, factor * along_Pa_s_m, factor * across_Pa_s_m, one.inertial_loss
    cells = int(index.max(initial=-1)) + 1
    number, found, sums = np.full(cells, -1, np.int32), np.zeros(cells, np.int32), np.zeros((cells, sheet.COLUMNS))
    frame = np.array([*origin_mm, cell_size_mm])
    rows = sheet.spread(index, frame, (one.points_mm, one.normals, *values), number, found, sums)
    order = np.argsort(found[:rows])
    order = order[sums[order, 3] > 0]
    found, sums = found[order], sums[order]
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


def _combined(alone: Sequence[GridResistance]) -> GridResistance:
    """Return the resistance of several sheets together (see this module)."""
    of_all = [np.concatenate([getattr(one, part.name) for one in alone]) for part in fields(GridResistance)]
    number, normal, along, across, spread, loss = of_all
    cell, row = np.unique(number, return_inverse=True)

    def total(values: Floats) -> Floats:
        """Return the sums of values (e, ...) over the sheets of every cell."""
        sums = np.zeros((len(cell), *values.shape[1:]))
        np.add.at(sums, row, values)
        return sums

    square, weight = normal[:, :, None] * normal[:, None, :], along + across
    size, axes = np.linalg.eigh(total(weight[:, None, None] * square))
    leads = size[:, 1] - size[:, 0] <= size[:, 2] - size[:, 1]
    axis = np.where(leads[:, None], axes[:, :, 2], axes[:, :, 0])
    axis[size[:, 2] <= 0] = 0.0  # a region alone
    squared = np.einsum("ed,ed->e", axis[row], normal) ** 2
    along_axis = total(across + (along - across) * squared)
    across_axis = 0.5 * (total(along + 2 * across) - along_axis)
    # Of the velocity across the axis, a sheet at an angle to it takes part only with what lies in the sheet.
    spread = total(across * (0.5 + 0.5 * squared) * spread) / np.maximum(total(across), 1e-300)
    is_shared_region = ~normal.any(axis=1) & axis[row].any(axis=1)
    loss = np.where(is_shared_region, 0.5 * loss, loss)  # `collision.resist` halves that of a region alone itself
    return GridResistance(cell, axis, along_axis, across_axis, spread, total(loss))
